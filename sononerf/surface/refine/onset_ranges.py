# SPDX-License-Identifier: MIT
r"""How far the nearest point of a surface is from where each pose's first echo began.

The nearest point of a body always sends an echo, even if it is an edge or a corner. So the least
range over the surface must be the onset. Physical optics alone does not ensure this: if a pose
hears only a quiet edge, the descent can make the edge quieter by cutting it off.

Up to ``SCALE`` the misfit is quadratic, beyond it is linear (Huber's loss).
"""

from __future__ import annotations

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from sononerf.echoes.free_space import EchoHull

SCALE = 0.19
"""Misfit at which Huber's loss turns linear, range resolutions. At 0.1, the accuracy of the
detector, the onsets outweigh the spectrograms: the Chamfer distance of ua rises from 0.94 mm to
1.25 mm (means of two seeds of the refinement)."""
_POSES = 64  # drawn per step, to bound the time


class OnsetRanges:
    """The onsets of the training poses, to compare surfaces with.

    Args:
        hull: Onsets; those of weight zero take no part.
        resolution (m): Range resolution of the analysis.
        seed: Of the order in which poses are drawn.
    """

    def __init__(self, hull: EchoHull, resolution: float, seed: int) -> None:
        self.scale, self.seed = SCALE * resolution, seed
        known = np.isfinite(hull.trusted)
        pose, ear = np.nonzero(known)
        self._first = hull.trusted[known]
        self._emitters, self._receivers = hull.emitters[pose], hull.receivers[pose, ear]

    def __len__(self) -> int:
        return len(self._first)

    def misfit(self, vertices: Tensor) -> float:
        """Mean Huber loss of the least range of vertices (V, 3), m; no unit; 0 without onsets."""
        if not len(self):
            return 0.0
        lots = np.array_split(np.arange(len(self)), -(-len(self) // _POSES))
        off = torch.cat([self._off(vertices, some)[0] for some in lots]).abs()
        return float(torch.where(off < 1.0, 0.5 * off.square(), off - 0.5).mean())

    def gradient(self, vertices: Tensor, number: int) -> Tensor:
        """Gradient (V, 3), 1/m, of the misfit of a step's onsets; ``number`` is the step's."""
        found = torch.zeros_like(vertices)
        if not len(self):
            return found
        rng = np.random.default_rng([self.seed, number])
        some = rng.choice(len(self), min(_POSES, len(self)), replace=False)
        off, nearest, way = self._off(vertices, some)
        slope = off.clamp(-1.0, 1.0)[:, None] * way / (self.scale * len(some))
        return found.index_add_(0, nearest, slope)

    def _off(self, vertices: Tensor, some: NDArray[np.intp]) -> tuple[Tensor, Tensor, Tensor]:
        """Return misfit (N,), nearest vertex (N,) and the range's gradient there (N, 3)."""
        emitters, receivers, first = (
            torch.as_tensor(part[some]).to(vertices)
            for part in (self._emitters, self._receivers, self._first)
        )
        ranges = (torch.cdist(vertices, emitters) + torch.cdist(vertices, receivers)) / 2
        least, nearest = ranges.min(0)
        out, back = vertices[nearest] - emitters, vertices[nearest] - receivers
        way = out / out.norm(dim=1, keepdim=True) + back / back.norm(dim=1, keepdim=True)
        return (least - first) / self.scale, nearest, way / 2
