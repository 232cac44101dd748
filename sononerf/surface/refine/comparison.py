# SPDX-License-Identifier: MIT
"""Error of a surface on poses that it was not fitted to."""

from __future__ import annotations

import math

import numpy as np
import torch
import trimesh

from sononerf.array_types import Singles
from sononerf.echoes.echoes import Echoes
from sononerf.head.decibels import ACTIVE_DB, compress
from sononerf.surface.refine.descent import ONSETS
from sononerf.surface.refine.objective import FLOOR_DB, Level, OnsetRanges
from sononerf.surface.refine.optics import Optics
from sononerf.surface.refine.remesh import finer
from sononerf.surface.refine.tracer import Tracer

ASKED = 24
"""Number of validation poses, at most, that compare surfaces."""
LATE = 0.25
"""By how much the onsets may come late, range resolutions: an echo is found when it has risen.
Those of true bodies of bars come late by 0.14 at the median. Free surfaces follow them; counted as
they are, they would be an error of the truth."""
RAYS = 30_000
"""Number of rays per validation pose; on three spheres the result differs from that of 300,000 rays
by 0.2 dB."""


class Comparison:
    """Comparison of surfaces by the validation poses and the onsets.

    The mean error of validation poses, traced off the surface by the simulator's rays, and the
    misfit of the onsets as in the descent. A pose counts by the square root of its loudest cell:
    quiet poses hear edges, whose echoes change by decibels where one is rounded by a tenth of a
    wavelength. Physical optics without edges ranks surfaces with edges badly.

    Args:
        echoes: The measured echoes.
        optics: The head.
        onsets: Onsets of the training poses.
        seed: Seed of the rays.
    """

    def __init__(self, echoes: Echoes, optics: Optics, onsets: OnsetRanges, seed: int) -> None:
        self.echoes, self.optics, self.onsets, self.seed = echoes, optics, onsets, seed
        chosen = np.linspace(0, len(echoes.validation) - 1, min(ASKED, len(echoes.validation)))
        self.poses = echoes.validation[chosen.astype(np.int64)]

    def objective(self, mesh: trimesh.Trimesh, level: Level, *, smooth: bool) -> float:
        """Return the error of a surface and the misfit of its onsets, dB; as :meth:`error`."""
        return self.error(mesh, level, smooth=smooth) + self.misfit(mesh)

    def misfit(self, mesh: trimesh.Trimesh) -> float:
        """Return the part of the objective that the onsets have, dB."""
        vertices = torch.as_tensor(np.array(mesh.vertices, dtype=np.float64))
        return ONSETS * self.onsets.misfit(vertices, LATE * self.optics.head.resolution)

    def error(self, mesh: trimesh.Trimesh, level: Level, *, smooth: bool) -> float:
        """Return the error of a surface on the validation poses, dB; infinite if all are silent.

        Args:
            mesh: m.
            level: Its gains are applied.
            smooth: True if the vertices lie on a smooth surface; coarse triangles are then divided.

        Raises:
            SonoNerfError: If no echoes can be traced off the surface.
        """
        gain = level.gain.exp().cpu().numpy()[:, None]
        positions, rotations = self.echoes.positions, self.echoes.rotations
        if smooth:
            mesh, _ = finer(mesh, np.zeros(len(mesh.vertices)), self.optics.wavelength)
        tracer = Tracer(self.optics, mesh, rays=RAYS, seed=self.seed)
        rendered = list(gain * tracer.spectrograms(positions[self.poses], rotations[self.poses]))
        heard = [self.echoes.magnitude(pose).numpy() for pose in self.poses.tolist()]
        weights = [math.sqrt(float(one.max())) for one in heard]
        if not sum(weights) > 0:
            return math.inf
        # Without an absolute level each surface gets one gain first.
        common = 1.0 if self.echoes.calibrated else _common_gain(heard, rendered)
        errors = [_difference(a, common * b) for a, b in zip(heard, rendered, strict=True)]
        return float(np.average(errors, weights=weights))


def _common_gain(heard: list[Singles], rendered: list[Singles]) -> float:
    """Median over poses and ears of the loudest heard over the loudest rendered magnitude."""
    a, b = (np.stack(part).max(axis=(2, 3)) for part in (heard, rendered))
    both = (a > 0) & (b > 0)
    return float(np.median(a[both] / b[both])) if both.any() else 1.0


def _difference(heard: Singles, rendered: Singles) -> float:
    """Mean difference of spectrograms (E, R, F) over the active cells, compressed decibels."""
    reference = max(float(heard.max()) * 10.0 ** (-FLOOR_DB / 20.0), 1e-30)
    a, b = compress(heard, reference), compress(rendered, reference)
    active = (a >= ACTIVE_DB) | (b >= ACTIVE_DB)
    return float(np.abs(a - b)[active].mean()) if active.any() else 0.0
