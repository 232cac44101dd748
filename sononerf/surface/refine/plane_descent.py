# SPDX-License-Identifier: MIT
"""A stage of a refinement in which flat parts move as patches, with the sound of their edges."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable
from dataclasses import replace

import numpy as np
import torch
import trimesh
from torch import Tensor

from sononerf.echoes.echoes import Echoes
from sononerf.numerics import Floats, Ints
from sononerf.surface.refine.descent import LAST, MEMORY, MOMENTUM
from sononerf.surface.refine.edges import Edges
from sononerf.surface.refine.mesh_operators import MeshOperators, unit
from sononerf.surface.refine.objective import Level, differences, measured, mismatch
from sononerf.surface.refine.optics import Heard, Optics
from sononerf.surface.refine.patches import Patches, motions, on_patches, patches_of
from sononerf.surface.refine.planes import flat_parts
from sononerf.surface.refine.tracer import LaterBounces
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
LARGEST = 3.0
"""Largest step of a motion, in steps of the usual length."""
FARTHEST = 1.5
"""Distance that a vertex of an edge can move in a stage, shortest wavelengths: a corner that is
rounded by a wavelength comes back, but no spike grows."""
EVENED = 5
"""Number of steps after which triangles are made even again; those that were turned over along an
edge would sound like many edges."""


def flattened(
    mesh: trimesh.Trimesh, wavelength: float, *, bent: bool = False
) -> tuple[trimesh.Trimesh, Ints, Patches]:
    """Return a mesh with its parts on patches, the part of each triangle (T,), and the patches.

    In: wavelength (m).
    """
    tolerance = TOLERANCE * wavelength
    part = flat_parts(mesh, tolerance, (LEAST * wavelength) ** 2)
    patches = patches_of(mesh, part, tolerance, bent=bent)
    home = np.asarray(mesh.vertices)
    return on_patches(mesh, part, patches, home, FARTHEST * wavelength), part, patches


def flattest(
    meshes: Iterable[trimesh.Trimesh], error: Callable[[trimesh.Trimesh], float], optics: Optics
) -> trimesh.Trimesh | None:
    """Return the surface that explains the echoes best with its flat parts on planes."""

    def on_planes(mesh: trimesh.Trimesh) -> float:
        return error(flattened(mesh, optics.wavelength)[0])

    first, *others = [mesh for mesh in meshes if mesh.is_watertight] or [None]
    if first is None or (least := on_planes(first)) >= error(first):
        return None
    errors = [least, *(on_planes(mesh) for mesh in others)]
    return [first, *others][int(np.argmin(errors))]


class PlaneDescent:
    """Descent of the numbers of patches: planes, and paraboloids where ``band`` is below 1.

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
        self.bent = band < 1.0
        flat, part, self.patches = flattened(mesh, optics.wavelength, bent=self.bent)
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
        self.terms = 6 if self.bent else 3
        self.direction = np.zeros(self.terms * count)
        self.square = np.zeros(self.terms * count)
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
        motion = motions(self.vertices, self.faces, self.part, self.patches, self.terms)
        slope = motion.T @ gradient.ravel()
        self.direction = MOMENTUM * self.direction + (1 - MOMENTUM) * slope
        self.square = MEMORY * self.square + (1 - MEMORY) * np.square(slope)
        usual = self.square / (1 - MEMORY**self.count)
        usual = np.sqrt(usual + QUIET**2 * usual.mean()) + 1e-300
        rate = self.rate * (LAST + (1 - LAST) * 0.5 * (1 + math.cos(math.pi * part)))
        step = self.direction / (1 - MOMENTUM**self.count) / usual
        change = -rate * np.clip(step, -LARGEST, LARGEST)
        self.vertices = self.vertices + (motion @ change).reshape(-1, 3)
        numbers = self.patches.numbers.copy()
        numbers[:, : self.terms] += change.reshape(-1, self.terms)
        self.patches = replace(self.patches, numbers=numbers)
        if self.count % EVENED == 0:
            far = FARTHEST * self.optics.wavelength
            mesh = on_patches(self.mesh(), self.part, self.patches, self._start, far)
            self.vertices = np.array(mesh.vertices)
        return error

    def render(self, numbers: list[int], vertices: Tensor) -> Heard | None:
        """Render poses; None where none of them hears anything.

        In: vertices ((V, 3) float64, m).
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
        means = unit(whole.index_add(0, self._plane.to(area.device), area))
        normals = self._at_edges(vertices, means)
        far = self.optics.heads(positions, rotations)
        edges = self.edges.heard(self.optics, vertices, normals, sight, far)
        if edges is None and not len(pieces.pose):
            return None
        points = (apart - middle).float()
        return self.optics.render(points, area.float(), pieces, heads, edges=edges)

    def _at_edges(self, vertices: Tensor, means: Tensor) -> Tensor:
        """Return the normals (K, 2, 3) of the patches that meet at edges.

        In: vertices ((V, 3), m), means (N, 3).
        """
        middle = vertices.detach().cpu().numpy()[self.edges.ends].mean(axis=1)
        patches = self.patches
        turned = [
            patches.normals(side, middle) - patches.normals(side, patches.centre[side])
            for side in self.edges.planes.T
        ]
        found = means[torch.as_tensor(self.edges.planes).to(means.device)]
        return unit(found + torch.as_tensor(np.stack(turned, axis=1)).to(found))

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
