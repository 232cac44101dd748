# SPDX-License-Identifier: MIT
"""A stage of a refinement in which flat parts move as planes, with the sound of their edges."""

from __future__ import annotations

import math

import numpy as np
import torch
import trimesh
from torch import Tensor

from sononerf.array_types import Floats, Ints
from sononerf.echoes.echoes import Echoes
from sononerf.surface.refine.descent import LAST, MEMORY, MOMENTUM
from sononerf.surface.refine.edges import Edges
from sononerf.surface.refine.later_bounces import LaterBounces
from sononerf.surface.refine.mesh_operators import MeshOperators, unit
from sononerf.surface.refine.objective import Level, differences, measured, mismatch
from sononerf.surface.refine.optics import Heard, Optics
from sononerf.surface.refine.planes import flat_parts, motions, on_planes, planes_of
from sononerf.surface.refine.visibility import listen, sight_of

TOLERANCE = 0.3
"""Standard deviation of a flat part from its plane, at most, shortest wavelengths: a start is known
to a third of a wavelength."""
LEAST = 1.4
"""Square root of the least area of a flat part, shortest wavelengths; a smaller one is no
mirror. Of bodies of bars, one ends at 0.68 mm for 1.04 mm with 2, another one at 0.67 for 0.78."""
RATE = 0.4
"""Length of the first steps of a plane, shortest wavelengths, over the rate of the stage."""
POSES = 16
"""Number of training poses per step; a plane is heard by few of them. A body of bars ends at
1.05 mm with 8 and at 0.98 mm with 16, in 1.07 times the time."""
QUIET = 0.1
"""Floor of a motion's usual gradient, as a fraction of the mean over all of them: planes move
little where little is heard."""
FARTHEST = 3.0
"""Largest step of a motion, in steps of the usual length."""
EVENED = 5
"""Number of steps after which triangles are made even again; those that were turned over along an
edge would sound like many edges."""


def flattened(mesh: trimesh.Trimesh, wavelength: float) -> tuple[trimesh.Trimesh, Ints]:
    """Return a mesh with its flat parts on planes, and the part of each triangle (T,).

    Args:
        mesh: m.
        wavelength (m): The shortest.
    """
    tolerance = TOLERANCE * wavelength
    part = flat_parts(mesh, tolerance, (LEAST * wavelength) ** 2)
    return on_planes(mesh, part, *planes_of(mesh, part, tolerance)), part


class PlaneDescent:
    """Descent of the numbers of planes.

    Args:
        mesh: Its flat parts are put on planes, m.
        echoes, optics, level: Measurement, head, and gains, which are updated.
        rate: As in :class:`~sononerf.surface.refine.descent.Stage`; ``RATE`` of it are wavelengths.
        later: Later bounces, added as power.
        band: As in :class:`~sononerf.surface.refine.descent.Stage`.
        seed: Seed of the poses.

    Attributes:
        part (T,): Number of each triangle's plane.
        vertices ((V, 3) float64, m): Present places.
    """

    def __init__(
        self,
        mesh: trimesh.Trimesh,
        echoes: Echoes,
        optics: Optics,
        level: Level,
        *,
        rate: float,
        later: LaterBounces | None = None,
        band: float = 0.0,
        seed: int,
    ) -> None:
        self.echoes, self.optics, self.level, self.seed = echoes, optics, level, seed
        self.rate, self.band, self._later = RATE * rate * optics.wavelength, band, later
        self.faces, self._start = np.array(mesh.faces, dtype=np.int64), np.array(mesh.vertices)
        flat, part = flattened(mesh, optics.wavelength)
        self.part, self.vertices = part, np.array(flat.vertices, dtype=np.float64)
        pairs, ends = mesh.face_adjacency, mesh.face_adjacency_edges
        self.edges = Edges(self.faces, part, np.asarray(pairs), np.asarray(ends))
        # At an edge each face has vertices of its own, so that its normals are not averaged.
        count = int(part.max()) + 1
        own, corner = np.unique(self.faces * count + part[:, None], return_inverse=True)
        self._vertex = torch.as_tensor(own // count)
        self._plane = torch.as_tensor(own % count)
        apart = torch.as_tensor(corner.reshape(-1, 3)).to(optics.get_buffer("wavenumber").device)
        self._operators = MeshOperators(apart, len(own))
        self.direction = np.zeros(3 * count)
        self.square = np.zeros(3 * count)
        self.count = 0

    def mesh(self) -> trimesh.Trimesh:
        """Return the present surface."""
        return trimesh.Trimesh(self.vertices.copy(), self.faces, process=False)

    def step(self, number: int, part: float) -> float:
        """Do one step; see :meth:`sononerf.surface.refine.descent.Descent.step`."""
        gradient, error = self._gradient(number)
        if gradient is None:
            return error
        self.count += 1
        motion = motions(self.vertices, self.faces, self.part)
        slope = motion.T @ gradient.ravel()
        self.direction = MOMENTUM * self.direction + (1 - MOMENTUM) * slope
        self.square = MEMORY * self.square + (1 - MEMORY) * np.square(slope)
        usual = self.square / (1 - MEMORY**self.count)
        usual = np.sqrt(usual + QUIET**2 * usual.mean()) + 1e-300
        rate = self.rate * (LAST + (1 - LAST) * 0.5 * (1 + math.cos(math.pi * part)))
        step = self.direction / (1 - MOMENTUM**self.count) / usual
        moved = motion @ (-rate * np.clip(step, -FARTHEST, FARTHEST))
        self.vertices = self.vertices + moved.reshape(-1, 3)
        if self.count % EVENED == 0:
            mesh = self.mesh()
            planes = planes_of(mesh, self.part, self.optics.wavelength)
            self.vertices = np.array(on_planes(mesh, self.part, *planes).vertices)
        return error

    def render(self, numbers: list[int], vertices: Tensor) -> Heard | None:
        """Render poses; None where none of them hears anything.

        Args:
            numbers: Poses.
            vertices ((V, 3) float64, m): Present places; gradients run to them.
        """
        positions, rotations = (
            torch.as_tensor(part[numbers]).to(vertices)
            for part in (self.echoes.positions, self.echoes.rotations)
        )
        apart = vertices[self._vertex.to(vertices.device)]
        area = self._operators.areas(apart)
        sight = sight_of(self.optics, vertices.detach().cpu().numpy(), self.faces)
        flat = apart.new_zeros(len(apart), 6)
        still = apart.detach()
        pieces, heads, middle = listen(
            self.optics, self._operators, still, area.detach(), flat, sight, positions, rotations
        )
        whole = area.new_zeros(int(self.part.max()) + 1, 3)
        normals = unit(whole.index_add(0, self._plane.to(area.device), area))
        far = self.optics.heads(positions, rotations)
        edges = self.edges.heard(self.optics, vertices, normals, sight, far)
        if edges is None and not len(pieces.pose):
            return None
        points = (apart - middle).float()
        return self.optics.render(points, area.float(), pieces, heads, edges=edges)

    def _gradient(self, number: int) -> tuple[Floats | None, float]:
        """Return the gradient (V, 3), dB/m, and the mean mismatch, dB."""
        numbers = self.echoes.batch(self.seed, number, POSES).tolist()
        like = self.optics.get_buffer("wavenumber")
        vertices = torch.as_tensor(self.vertices).to(like.device).requires_grad_(True)
        heard = self.render(numbers, vertices)
        if heard is None:
            return None, math.inf
        found = measured(self.echoes, numbers, heard)
        later = None if self._later is None else self._later.power(numbers, heard)
        difference, weight = differences(
            heard, later, found, self.level, learn=True, band=self.band
        )
        error = mismatch(difference, weight).mean()
        (gradient,) = torch.autograd.grad(error, vertices)
        return gradient.cpu().numpy(), float(error.detach())

    def state(self) -> dict[str, Tensor]:
        """Return the whole state, and the initial mesh, as plain tensors."""
        parts = {
            "start": self._start,
            "faces": self.faces,
            "vertices": self.vertices,
            "direction": self.direction,
            "square": self.square,
        }
        found = {name: torch.as_tensor(np.array(part)) for name, part in parts.items()}
        return {**found, "count": torch.tensor(self.count)}

    def load(self, state: dict[str, Tensor]) -> None:
        """Load the state of a descent on the same mesh."""
        self.vertices, self.direction, self.square = (
            state[name].numpy() for name in ("vertices", "direction", "square")
        )
        self.count = int(state["count"])
