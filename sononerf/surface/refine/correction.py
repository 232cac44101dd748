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
from sononerf.surface.refine.mesh_operators import MeshOperators, smoothing_passes, unit
from sononerf.surface.refine.objective import on_rows
from sononerf.surface.refine.optics import Heard, Optics
from sononerf.surface.refine.visibility import listen, sight_of


class Correction:
    """Simulated and rendered echoes of one surface, for some poses.

    Args:
        optics: Renders.
        mesh: The surface, m.
        simulator: Simulator of the same surface.
        echoes: Echoes with the poses.
        numbers (N,): Numbers of the poses.
        seed: Seed of the simulated rays.
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
        self._optics, self._echoes = optics, echoes
        like = optics.get_buffer("wavenumber")
        faces = np.array(mesh.faces, dtype=np.int64)
        self._vertices = torch.as_tensor(np.array(mesh.vertices, dtype=np.float64)).to(like.device)
        self._operators = MeshOperators(torch.as_tensor(faces).to(like.device), len(mesh.vertices))
        self._area = self._operators.areas(self._vertices)
        passes = smoothing_passes(optics.wavelength, self._operators.edge_length(self._vertices))
        self._bending = self._operators.bending(self._vertices, unit(self._area), passes)
        self._sight = sight_of(optics, np.asarray(mesh.vertices, dtype=np.float64), faces)
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

        Args:
            numbers: Poses.
            heard: A rendering with the wanted rows.

        Returns:
            simulated, rendered ((P, E, W, F) float32): Linear; zero beyond the axis.
        """
        for number in numbers:
            if number not in self._kept:
                self._kept[number] = self._simulated[number], self._rendered(number)
        first, second = (
            on_rows([self._kept[number][part] for number in numbers], heard.row, heard.power)
            for part in (0, 1)
        )
        return first, second

    def _rendered(self, number: int) -> Tensor:
        position, rotation = (
            torch.as_tensor(part[number : number + 1]).to(self._vertices)
            for part in (self._echoes.positions, self._echoes.rotations)
        )
        pieces, heads, middle = listen(
            self._optics,
            self._operators,
            self._vertices,
            self._area,
            self._bending,
            self._sight,
            position,
            rotation,
        )
        found = torch.zeros(self._optics.ears, self._optics.rows, len(self._optics.frequencies))
        if not len(pieces.pose):
            return found
        points = (self._vertices - middle).float()
        heard = self._optics.render(points, self._area.float(), pieces, heads)
        row, width = int(heard.row[0]), heard.power.shape[2]
        first, last = max(row, 0), min(row + width, found.shape[1])
        if last > first:
            found[:, first:last] = heard.power[0, :, first - row : last - row].sqrt().cpu()
        return found
