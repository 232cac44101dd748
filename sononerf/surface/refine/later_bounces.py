# SPDX-License-Identifier: MIT
"""Later bounces off the current surface, as power beside the first one."""

from __future__ import annotations

from collections.abc import Iterable

import numpy as np
import torch
import trimesh
from torch import Tensor

from sononerf.echoes.echoes import Echoes
from sononerf.executor import computed
from sononerf.simulation.workers import useful_workers
from sononerf.surface.refine.optics import Heard, Optics
from sononerf.surface.refine.tracer import LATER_RAYS, Later, Tracer


class LaterBounces:
    """Later bounces off one surface."""

    def __init__(self, optics: Optics, mesh: trimesh.Trimesh, echoes: Echoes, *, seed: int) -> None:
        self._optics, self._echoes = optics, echoes
        self._tracer = Tracer(optics, mesh, rays=LATER_RAYS, seed=seed)
        self._kept: dict[int, Later] = {}

    def trace(self, numbers: Iterable[int]) -> None:
        """Trace those of some poses that were not traced before; many at a time go faster."""
        positions, rotations = self._echoes.positions, self._echoes.rotations
        left = {n: (positions[n], rotations[n]) for n in numbers if n not in self._kept}
        workers = useful_workers(len(left), LATER_RAYS)
        if workers > 1:
            self._kept.update(computed(Tracer.later, self._tracer, left, workers))
        else:
            self._kept.update({n: self._tracer.later(*pose) for n, pose in left.items()})

    def power(self, numbers: list[int], heard: Heard) -> Tensor:
        """Power (P, E, W, F) of poses, on the rows that were rendered."""
        self.trace(numbers)
        found = [self._kept[number] for number in numbers]
        pose = np.repeat(np.arange(len(found)), [len(one.ear) for one in found])
        ear, delay, weight = (
            torch.as_tensor(np.concatenate([getattr(one, name) for one in found]))
            for name in ("ear", "delay", "weight")
        )
        like = heard.power
        return self._optics.later_power(
            torch.as_tensor(pose).to(like.device),
            ear.to(like.device),
            delay.to(like.device),
            weight.to(like.device),
            heard,
        )
