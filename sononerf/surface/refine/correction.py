# SPDX-License-Identifier: MIT
"""Correction of physical optics, from the simulated echoes of one surface.

Physical optics has no creeping waves, no multiple echoes and no soft shadows. On a surface that is
almost right, the simulator provides these. The ratio of simulated to rendered magnitude there, cell
by cell, corrects the rendering of a surface nearby. This is defect correction [1]_, known in
engineering design as space mapping [2]_: a fast model with gradients is aligned with an accurate
one without.

References:
    .. [1] H. J. Stetter, "The defect correction principle and discretization methods", Numerische
       Mathematik 29, 1978.
    .. [2] J. W. Bandler et al., "Space mapping technique for electromagnetic optimization", IEEE
       Trans. Microwave Theory and Techniques 42, 1994.
"""

from __future__ import annotations

import numpy as np
import torch
import trimesh
from torch import Tensor

from sononerf.array_types import Ints
from sononerf.echoes.echoes import Echoes
from sononerf.simulation.ensemble import spectrograms
from sononerf.simulation.simulator import Simulator
from sononerf.surface.refine.objective import on_rows
from sononerf.surface.refine.optics import Heard, Optics
from sononerf.surface.refine.still_surface import StillSurface


class Correction:
    """Simulated and rendered echoes of one surface, for some poses.

    In: numbers (N,).
    """

    def __init__(
        self,
        optics: Optics,
        mesh: trimesh.Trimesh,
        simulator: Simulator,
        echoes: Echoes,
        numbers: Ints,
        *,
        seed: int,
    ) -> None:
        self.numbers = numbers
        self._echoes = echoes
        self._surface = StillSurface(mesh, optics)
        self._kept: dict[int, tuple[Tensor, Tensor]] = {}
        places = np.asarray(echoes.positions[numbers], dtype=np.float64)
        turns = np.asarray(echoes.rotations[numbers], dtype=np.float64)
        heard = spectrograms(simulator, places, turns, seed=seed)
        self._simulated = dict(zip(numbers.tolist(), torch.as_tensor(heard), strict=True))

    def batch(self, seed: int, step: int, size: int) -> Ints:
        """Return the poses of a step, drawn from the seed and the step's number."""
        rng = np.random.default_rng([seed, step])
        return rng.choice(self.numbers, min(size, len(self.numbers)), replace=False)

    def magnitudes(self, numbers: list[int], heard: Heard) -> tuple[Tensor, Tensor]:
        """Return simulated and rendered echoes of the surface.

        Out: simulated, rendered ((P, E, W, F) float32).
        """
        for number in numbers:
            if number not in self._kept:
                at = slice(number, number + 1)
                echoes = self._echoes.positions[at], self._echoes.rotations[at]
                rendered = torch.as_tensor(self._surface.render(*echoes)[0])
                self._kept[number] = self._simulated[number], rendered
        first, second = (
            on_rows([self._kept[number][part] for number in numbers], heard.row, heard.power)
            for part in (0, 1)
        )
        return first, second
