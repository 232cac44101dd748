# SPDX-License-Identifier: MIT
"""Error between rendered and measured spectrograms, and the learned level."""

from __future__ import annotations

import math
from typing import Literal

import numpy as np
import torch
import trimesh
from numpy.typing import NDArray
from torch import Tensor, nn

from sononerf.echoes.echoes import Echoes
from sononerf.echoes.free_space import EchoHull
from sononerf.head.front_end import ACTIVE_DB, compress
from sononerf.numerics import Singles
from sononerf.refinement.optics import Heard, Optics
from sononerf.refinement.remesh import finer
from sononerf.refinement.tracer import Tracer, on_rows

ONSET_WEIGHT = 3.0
"""Weight of the misfit of onsets beside the mismatch, dB. Without it the edges of a box are cut
off; with 30 the surface follows the errors of the onsets."""
FLOOR_DB = 20.0
"""Level below a pose's loudest cell down to which cells count, dB; fainter cells are later
bounces."""
CORRECTED_FLOOR_DB = 30.0
"""FLOOR_DB where the simulator adds what physical optics lacks, such as later bounces, dB."""
ALIKE_DB = 3.0
"""Difference between simulator and physical optics at which a cell has half the weight, dB."""
LOUD_DB = 16.0
"""Level below a pose's loudest cell down to which cells determine the gain, dB."""
RUNNING_WEIGHT = 0.05
"""Weight of one step in the running means of gain and error, no unit."""
ERROR_EXPONENT = 4.0
"""Exponent of a frequency's usual error, by whose inverse power the frequency is weighted. Where
physical optics is wrong (ka below 10) the error stays large, and even a little of it biases the
surface."""
_DB = 20.0 / math.log(10.0)


class ErrorLevel:
    """Running estimates on the training poses: gain, and error per ear and frequency.

    Attributes:
        gain ((E, F) float32): Logarithm of measured over rendered magnitude.
        error ((E, F) float32, dB): Mean error over active cells.
        steps: Number of updates.
        learns: Whether there is no gain, or one for each ear and frequency.
    """

    def __init__(self, ears: int, rows: int, like: Tensor) -> None:
        self.gain = torch.zeros(ears, rows, device=like.device)
        self.error = torch.full((ears, rows), 4.0, device=like.device)
        self.steps = 0
        self.learns: Literal["none", "each"] = "each"

    def reset(self) -> None:
        """Reset all estimates."""
        self.gain, self.error = torch.zeros_like(self.gain), torch.full_like(self.error, 4.0)
        self.steps = 0

    def state(self) -> dict[str, Tensor]:
        """Return the state as plain tensors."""
        return {"gain": self.gain, "error": self.error, "steps": torch.tensor(self.steps)}

    def load(self, state: dict[str, Tensor]) -> None:
        """Load a state."""
        self.gain, self.error = state["gain"].to(self.gain), state["error"].to(self.error)
        self.steps = int(state["steps"])

    @property
    def weight(self) -> Tensor:
        """Weight of ears and frequencies (E, F), falling with their usual error."""
        weight = self.error.clamp_min(0.25 * float(self.error.median())) ** -ERROR_EXPONENT
        return weight / weight.mean()


def measured(echoes: Echoes, numbers: list[int], heard: Heard) -> tuple[Tensor, Tensor, Tensor]:
    """Return the measurement of poses on the rendered rows.

    Out: magnitude ((P, E, W, F) float32), inside (P, 1, W, 1), loudest ((P,) float32).
    """
    wholes = [echoes.magnitude(number) for number in numbers]
    width, count = heard.power.shape[2], wholes[0].shape[1]
    place = heard.row[:, None] + torch.arange(width, device=heard.row.device)
    inside = (place >= 0) & (place < count)
    loudest = torch.stack([whole.max() for whole in wholes])
    like = heard.power
    return (
        on_rows(wholes, heard.row, like),
        inside[:, None, :, None].to(like.device),
        loudest.to(like.device),
    )


def differences(
    heard: Heard,
    later: Tensor | None,
    measurement: tuple[Tensor, Tensor, Tensor],
    level: ErrorLevel,
    *,
    corrected: tuple[Tensor, Tensor] | None = None,
    learn: bool,
    band: float = 0.0,
) -> tuple[Tensor, Tensor]:
    """Return the measured levels less the rendered ones, by cells.

    In: later ((P, E, W, F) float32), corrected (simulated, rendered, both (P, E, W, F) float32).
    Out: difference ((P, E, W, F) float32, reported dB), weight (P, E, W, F).
    """
    magnitude, inside, loudest = measurement
    power = heard.power if later is None else heard.power + later
    if band:
        gained = level.gain.mul(2.0).exp()[:, None]
        power = over_band(power * gained, band) / gained
        magnitude = over_band(magnitude.square(), band).sqrt()
    tiny = (1e-6 * loudest.clamp_min(1e-30)).square()[:, None, None, None]
    gain = level.gain.exp()[:, None]
    rendered = torch.sqrt(power + tiny) * gain
    floor = FLOOR_DB if corrected is None else CORRECTED_FLOOR_DB
    reference = (loudest * 10.0 ** (-floor / 20.0)).clamp_min(1e-30)[:, None, None, None]
    a = _DB * torch.log1p(magnitude / reference)
    b = _DB * torch.log1p(rendered / reference)
    weight = level.weight[:, None]
    if corrected is not None:
        simulated, before = (_DB * torch.log1p(gain * part / reference) for part in corrected)
        b = b + (simulated - before)
        weight = 1.0 / (1.0 + (simulated - before).abs() / ALIKE_DB)
        rendered = reference * torch.expm1(b.detach().clamp_min(0.0) / _DB)
    with torch.no_grad():
        active = inside & ((a >= ACTIVE_DB) | (b >= ACTIVE_DB))
        if learn:
            _learn(level, magnitude, rendered, a, b, active, loudest)
        weight = active * weight
        weight = weight / weight.sum((1, 2, 3), keepdim=True).clamp_min(1e-12)
    return a - b, weight


def mismatch(difference: Tensor, weight: Tensor) -> Tensor:
    """Return the mean absolute difference over each pose's active cells, (P,) reported dB."""
    return (difference.abs() * weight).sum((1, 2, 3))


def over_band(power: Tensor, part: float) -> Tensor:
    """Return power (P, E, W, F), averaged over a fraction of the frequencies around each."""
    half = round(part * power.shape[3]) // 2
    if not half:
        return power
    rows = nn.functional.pad(power.flatten(0, 1), (half, half), mode="replicate")
    return nn.functional.avg_pool1d(rows, 2 * half + 1, 1).unflatten(0, power.shape[:2])


def _learn(
    level: ErrorLevel,
    magnitude: Tensor,
    rendered: Tensor,
    a: Tensor,
    b: Tensor,
    active: Tensor,
    loudest: Tensor,
) -> None:
    rate = max(RUNNING_WEIGHT, 1.0 / (level.steps + 2))
    level.steps += 1
    count = active.sum((0, 2))
    error = ((a - b).abs() * active).sum((0, 2)) / count.clamp_min(1)
    some = count > 0
    level.error = torch.where(some, level.error.lerp(error, rate), level.error)
    if level.learns == "none":
        return
    least = (loudest * 10.0 ** (-LOUD_DB / 20.0))[:, None, None, None]
    loud = (magnitude > least) & (rendered > 0.5 * least)
    ratio = torch.log(magnitude.clamp_min(1e-30) / rendered.clamp_min(1e-30))
    ratio = torch.where(loud, ratio, torch.nan)
    step = ratio.movedim(1, 0).movedim(3, 1).flatten(2).nanmedian(dim=2).values
    level.gain = level.gain + rate * torch.nan_to_num(step)


HUBER_SCALE = 0.19
"""Misfit at which Huber's loss turns linear, range resolutions. At 0.1, the accuracy of the
detector, the onsets outweigh the spectrograms: the Chamfer distance of ua rises from 0.94 mm to
1.25 mm (means of two seeds of the refinement)."""
_POSES = 64  # number that is drawn per step; it bounds the time


class OnsetRanges:
    """Onsets of the training poses, for comparison with a surface.

    The nearest point of a body always sends an echo, even if it is an edge or a corner. So the
    least range over the surface must be the onset. Physical optics alone does not ensure this: if a
    pose hears only a quiet edge, the descent can make the edge quieter by cutting it off.

    Up to ``HUBER_SCALE`` the misfit is quadratic, beyond it is linear (Huber's loss).

    In: resolution (m).
    """

    def __init__(self, hull: EchoHull, resolution: float, seed: int) -> None:
        self.scale, self.seed = HUBER_SCALE * resolution, seed
        known = np.isfinite(hull.inlier_onsets)
        pose, ear = np.nonzero(known)
        self._first = hull.inlier_onsets[known]
        self._emitters, self._receivers = hull.emitters[pose], hull.receivers[pose, ear]

    def __len__(self) -> int:
        return len(self._first)

    def misfit(self, vertices: Tensor, late: float = 0.0) -> float:
        """Return the mean Huber loss of the least range; no unit; 0 without onsets.

        In: vertices ((V, 3), m), late (m).
        """
        if not len(self):
            return 0.0
        lots = np.array_split(np.arange(len(self)), -(-len(self) // _POSES))
        off = torch.cat([self._off(vertices, some)[0] for some in lots])
        off = (off + (-off.median()).clamp(0.0, late / self.scale)).abs()
        return float(torch.where(off < 1.0, 0.5 * off.square(), off - 0.5).mean())

    def gradient(self, vertices: Tensor, number: int) -> Tensor:
        """Gradient (V, 3), 1/m, of the misfit of a step's onsets; ``number`` is the step's."""
        total = torch.zeros_like(vertices)
        if not len(self):
            return total
        rng = np.random.default_rng([self.seed, number])
        some = rng.choice(len(self), min(_POSES, len(self)), replace=False)
        off, nearest, gradient = self._off(vertices, some)
        slope = off.clamp(-1.0, 1.0)[:, None] * gradient / (self.scale * len(some))
        return total.index_add_(0, nearest, slope)

    def _off(self, vertices: Tensor, some: NDArray[np.intp]) -> tuple[Tensor, Tensor, Tensor]:
        """Return misfit (N,), nearest vertex (N,) and the range's gradient there (N, 3)."""
        emitters, receivers, first = (
            torch.as_tensor(part[some]).to(vertices)
            for part in (self._emitters, self._receivers, self._first)
        )
        ranges = (torch.cdist(vertices, emitters) + torch.cdist(vertices, receivers)) / 2
        least, nearest = ranges.min(0)
        out, back = vertices[nearest] - emitters, vertices[nearest] - receivers
        gradient = out / out.norm(dim=1, keepdim=True) + back / back.norm(dim=1, keepdim=True)
        return (least - first) / self.scale, nearest, gradient / 2


MAX_VALIDATION_POSES = 24
"""Number of validation poses, at most, that compare surfaces."""
ONSET_DELAY = 0.25
"""By how much the onsets may come late, range resolutions: an echo is found when it has risen.
Those of true bodies of bars come late by 0.14 at the median. Free surfaces follow them; counted as
they are, they would be an error of the truth."""
RAYS = 10_000
"""Number of rays per validation pose; on three spheres two patterns of them differ by 0.2 dB."""


class SurfaceComparison:
    """SurfaceComparison of surfaces by the validation poses and the onsets.

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
        chosen = np.linspace(
            0, len(echoes.validation) - 1, min(MAX_VALIDATION_POSES, len(echoes.validation))
        )
        self.poses = echoes.validation[chosen.astype(np.int64)]

    def objective(self, mesh: trimesh.Trimesh, level: ErrorLevel, *, smooth: bool) -> float:
        """Return the error of a surface and the misfit of its onsets, dB; as :meth:`error`."""
        return self.error(mesh, level, smooth=smooth) + self.misfit(mesh)

    def misfit(self, mesh: trimesh.Trimesh) -> float:
        """Return the part of the objective that the onsets have, dB."""
        vertices = torch.as_tensor(np.array(mesh.vertices, dtype=np.float64))
        return ONSET_WEIGHT * self.onsets.misfit(
            vertices, ONSET_DELAY * self.optics.head.resolution
        )

    def error(self, mesh: trimesh.Trimesh, level: ErrorLevel, *, smooth: bool) -> float:
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
