# SPDX-License-Identifier: MIT
"""Flat parts move as planes that meet in edges, whose sound is known."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable
from dataclasses import replace

import numpy as np
import torch
import trimesh
from torch import Tensor

from sononerf.echoes.echoes import Echoes
from sononerf.geometry.meshes import CREASE
from sononerf.geometry.raycast import Occlusion
from sononerf.numerics import Bools, Floats, Ints
from sononerf.refinement.descent import LAST_STEP, MOMENTUM, SQUARE_DECAY
from sononerf.refinement.objective import ErrorLevel, differences, measured, mismatch
from sononerf.refinement.optics import Heads, Heard, Optics, Paths
from sononerf.refinement.planes import Patches, flat_parts, motions, on_patches, patches_of
from sononerf.refinement.remesh import MeshOperators, unit
from sononerf.refinement.tracer import FREE_DISTANCE, LaterBounces, listen, seen, sight_of
from sononerf.simulation.diffraction import wedge_directivity

EDGE_LIFT = 0.02
"""Height above an edge from which it is seen, shortest wavelengths: more than the rounding of ray
casting, less than anything that is heard."""


class CreaseEdges:
    """Edges of a mesh between faces on different planes.

    A flat face is silent but where it mirrors, and what most poses hear of a body with flat faces
    is its edges. Each piece of an edge is a source with the directivity of a rigid wedge, as in the
    simulator. It depends on how the faces lie, so an edge tells of their tilt from all around.

    In: faces (T, 3), plane (T,), adjacency (K, 2), ends (K, 2).

    Attributes:
        ends (K', 2): Vertices of the edges; the first plane lies to their left.
        planes (K', 2): Numbers of the planes that meet.
    """

    def __init__(self, faces: Ints, plane: Ints, adjacency: Ints, ends: Ints) -> None:
        apart = plane[adjacency[:, 0]] != plane[adjacency[:, 1]]
        first, second = adjacency[apart].T
        ends, corners = ends[apart], faces[first]
        ahead = (corners == ends[:, :1]) & (np.roll(corners, -1, axis=1) == ends[:, 1:])
        self.ends = np.where(ahead.any(axis=1)[:, None], ends, ends[:, ::-1])
        self.planes = np.stack([plane[first], plane[second]], axis=1)

    def heard(
        self, optics: Optics, vertices: Tensor, normals: Tensor, sight: Occlusion, heads: Heads
    ) -> Paths | None:
        """Return the sound of the edges that poses see; None where they see none.

        Those count that are convex and sharper than a crease, as in the simulator.

        In: vertices ((V, 3) float64, m), normals ((K', 2, 3) float64).
        """
        places, upright = (part.detach().cpu().numpy() for part in (vertices, normals))
        first, second = upright[:, 0], upright[:, 1]
        start, end = places[self.ends[:, 0]], places[self.ends[:, 1]]
        convexity = np.einsum("kd,kd->k", np.cross(first, second), end - start)
        cosine = np.einsum("kd,kd->k", first, second)
        sharp = np.flatnonzero((convexity > 0.0) & (cosine <= math.cos(CREASE)))
        pose, edge, visible = _seen(
            optics, start[sharp], end[sharp], first[sharp], second[sharp], sight, heads
        )
        if not len(pose):
            return None
        of = sharp[edge]
        ends = torch.as_tensor(self.ends[of]).to(vertices.device)
        heard = torch.as_tensor(visible).to(vertices.device)
        return _sound(
            optics,
            vertices[ends],
            normals[torch.as_tensor(of).to(normals.device)],
            torch.as_tensor(pose).to(vertices.device),
            heard,
            heads,
        )


def _seen(
    optics: Optics,
    start: Floats,
    end: Floats,
    first: Floats,
    second: Floats,
    sight: Occlusion,
    heads: Heads,
) -> tuple[Ints, Ints, Bools]:
    """Return pose, edge (Q,) and whether each ear sees it (Q, E), of edges that are lit."""
    emitters, ears = heads.emitters.cpu().numpy(), heads.ears.cpu().numpy()
    middle = 0.5 * (start + end)
    above = [np.einsum("pkd,kd->pk", emitters[:, None] - middle, side) for side in (first, second)]
    pose, edge = np.nonzero((above[0] > 0.0) | (above[1] > 0.0))
    away = first + second
    away /= np.linalg.norm(away, axis=1, keepdims=True)
    place = (middle + EDGE_LIFT * optics.wavelength * away)[edge]
    free = FREE_DISTANCE * optics.wavelength
    lit = seen(sight, place, emitters[pose], free=free)
    pose, edge, place = pose[lit], edge[lit], place[lit]
    visible = np.zeros((len(pose), optics.ears), dtype=bool)
    for ear in range(optics.ears):
        visible[:, ear] = seen(sight, place, ears[pose, ear], free=free)
    some = visible.any(axis=1)
    return pose[some], edge[some], visible[some]


def _sound(
    optics: Optics, ends: Tensor, normals: Tensor, pose: Tensor, visible: Tensor, heads: Heads
) -> Paths:
    """Return the sound of edges with ends (Q, 2, 3), m, between planes of normals (Q, 2, 3)."""
    first, second = normals.unbind(1)
    along = unit(torch.linalg.cross(first, second))
    inward = torch.linalg.cross(first, along)
    cosine = (first * second).sum(1).clamp(-1.0 + 1e-9, 1.0 - 1e-9)
    open_angle = math.pi + torch.arccos(cosine)
    length = (ends[:, 1] - ends[:, 0]).norm(dim=1)
    out = ends.mean(1) - heads.emitters[pose]
    back = ends.mean(1)[:, None] - heads.ears[pose]
    d1, d2 = out.norm(dim=1), back.norm(dim=2)
    wavenumber, decay = optics.get_buffer("wavenumber"), optics.get_buffer("decay")
    fade = optics.get_buffer("fade").double()
    with torch.no_grad():
        beam = optics.gains(
            torch.zeros_like(pose), (out / d1[:, None]).float(), heads.emitting[pose].float()
        )
    weights = []
    for ear in range(optics.ears):
        towards = back[:, ear] / d2[:, ear, None]
        with torch.no_grad():
            of = torch.full_like(pose, 1 + ear)
            gain = beam * optics.gains(of, towards.float(), heads.hearing[pose].float())
        wedge = wedge_directivity(inward, first, open_angle, -out, -back[:, ear], fade, xp=torch)
        # The standard deviation of the path's length over the piece.
        slope = (along * (out / d1[:, None] + towards)).sum(1)
        spread = (slope * length).square().float() / 12.0
        path = (d1 + d2[:, ear]).float()
        loss = torch.outer(spread, 0.5 * wavenumber.square()) + torch.outer(path, decay)
        weights.append(gain * wedge.float() * torch.exp(-loss) * visible[:, ear, None])
    strength = length[:, None] / (2.0 * math.pi * d1[:, None] * d2)
    return Paths(pose, strength.float(), (d1[:, None] + d2).float(), torch.stack(weights, 1))


MAX_PLANE_DEVIATION = 0.3
"""Standard deviation of a flat part from its plane, at most, shortest wavelengths: a start is known
to a third of a wavelength."""
MIN_PART_SIZE = 1.4
"""Square root of the least area of a flat part, shortest wavelengths; a smaller one is no
mirror. Of bodies of bars, one ends at 0.68 mm for 1.04 mm with 2, another one at 0.67 for 0.78."""
FIRST_STEP = 0.4
"""Length of the first steps of a plane, shortest wavelengths, over the rate of the stage."""
POSES = 16
"""Number of training poses per step; a plane is heard by few of them. A body of bars ends at
1.05 mm with 8 and at 0.98 mm with 16, in 1.07 times the time."""
GRADIENT_FLOOR = 0.1
"""Floor of a motion's usual gradient, as a fraction of the mean over all of them: planes move
little where little is heard."""
MAX_STEP = 3.0
"""Largest step of a motion, in steps of the usual length."""
MAX_VERTEX_MOVE = 1.5
"""Distance that a vertex of an edge can move in a stage, shortest wavelengths: a corner that is
rounded by a wavelength comes back, but no spike grows."""
REMESH_STEPS = 5
"""Number of steps after which triangles are made even again; those that were turned over along an
edge would sound like many edges."""


def flattened(
    mesh: trimesh.Trimesh, wavelength: float, *, bent: bool = False
) -> tuple[trimesh.Trimesh, Ints, Patches]:
    """Return a mesh with its parts on patches, the part of each triangle (T,), and the patches.

    In: wavelength (m).
    """
    tolerance = MAX_PLANE_DEVIATION * wavelength
    part = flat_parts(mesh, tolerance, (MIN_PART_SIZE * wavelength) ** 2)
    patches = patches_of(mesh, part, tolerance, bent=bent)
    home = np.asarray(mesh.vertices)
    return on_patches(mesh, part, patches, home, MAX_VERTEX_MOVE * wavelength), part, patches


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
        level: ErrorLevel,
        *,
        rate: float,
        later: LaterBounces | None = None,
        band: float = 0.0,
        seed: int,
    ) -> None:
        self.echoes, self.optics, self.level, self.seed = echoes, optics, level, seed
        self.rate, self.band, self._later = FIRST_STEP * rate * optics.wavelength, band, later
        self.faces, self._start = np.array(mesh.faces, dtype=np.int64), np.array(mesh.vertices)
        self.bent = band < 1.0
        flat, part, self.patches = flattened(mesh, optics.wavelength, bent=self.bent)
        self.part, self.vertices = part, np.array(flat.vertices, dtype=np.float64)
        pairs, ends = mesh.face_adjacency, mesh.face_adjacency_edges
        self.edges = CreaseEdges(self.faces, part, np.asarray(pairs), np.asarray(ends))
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
        """Do one step; see :meth:`sononerf.refinement.descent.Descent.step`."""
        gradient, error = self._gradient(number)
        if gradient is None:
            return error
        self.count += 1
        motion = motions(self.vertices, self.faces, self.part, self.patches, self.terms)
        slope = motion.T @ gradient.ravel()
        self.direction = MOMENTUM * self.direction + (1 - MOMENTUM) * slope
        self.square = SQUARE_DECAY * self.square + (1 - SQUARE_DECAY) * np.square(slope)
        usual = self.square / (1 - SQUARE_DECAY**self.count)
        usual = np.sqrt(usual + GRADIENT_FLOOR**2 * usual.mean()) + 1e-300
        rate = self.rate * (LAST_STEP + (1 - LAST_STEP) * 0.5 * (1 + math.cos(math.pi * part)))
        step = self.direction / (1 - MOMENTUM**self.count) / usual
        change = -rate * np.clip(step, -MAX_STEP, MAX_STEP)
        self.vertices = self.vertices + (motion @ change).reshape(-1, 3)
        numbers = self.patches.numbers.copy()
        numbers[:, : self.terms] += change.reshape(-1, self.terms)
        self.patches = replace(self.patches, numbers=numbers)
        if self.count % REMESH_STEPS == 0:
            far = MAX_VERTEX_MOVE * self.optics.wavelength
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
        tilt = [
            patches.normals(side, middle) - patches.normals(side, patches.centre[side])
            for side in self.edges.planes.T
        ]
        found = means[torch.as_tensor(self.edges.planes).to(means.device)]
        return unit(found + torch.as_tensor(np.stack(tilt, axis=1)).to(found))

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
