# SPDX-License-Identifier: MIT
"""Visibility of a surface from emitter and ears, and its rendering."""

from __future__ import annotations

import numpy as np
import torch
import trimesh
from torch import Tensor

from sononerf.geometry.raycast import Occlusion
from sononerf.numerics import Bools, Floats, Ints, Singles
from sononerf.surface.refine.mesh_operators import MeshOperators, smoothing_passes, unit
from sononerf.surface.refine.optics import SILENT, Heads, Optics, Pieces

FREE = 0.25
"""Distance in front of a piece within which nothing hides it, shortest wavelengths. Objects so
close throw no shadow, and the other side of a thin sheet that was pushed through must not hide
it."""


def seen(sight: Occlusion, points: Floats, target: Floats, *, free: float) -> Bools:
    """Return which points (N, 3) on the surface are seen from targets (N, 3), m.

    In: points, target ((N, 3), m), free (m).
    """
    span = target - points
    distance = np.sqrt(np.einsum("nd,nd->n", span, span))[:, None]
    part = np.minimum(free / np.maximum(distance, 1e-300), 0.5)
    return ~sight.blocked(points + part * span, target)


def sight_of(optics: Optics, vertices: Floats, faces: Ints) -> Occlusion:
    """Return the search structure of a surface, on a support with its image.

    In: vertices ((V, 3), m), faces (T, 3).
    """
    if optics.plane is None:
        return Occlusion(vertices, faces)
    both = np.concatenate([vertices, optics.plane.mirrored(vertices)])
    return Occlusion(both, np.concatenate([faces, faces[:, ::-1] + len(vertices)]))


def listen(
    optics: Optics,
    operators: MeshOperators,
    vertices: Tensor,
    area: Tensor,
    bending: Tensor,
    sight: Occlusion,
    positions: Tensor,
    rotations: Tensor,
) -> tuple[Pieces, Heads, Tensor]:
    """Return the pieces of a surface that poses hear.

    In: vertices, area, bending ((V, 3), (V, 3), (V, 6) float64), positions, rotations ((P, 3), (P,
    3, 3) float64). Out: middle ((3,), m).
    """
    middle = 0.5 * (vertices.amin(0) + vertices.amax(0))
    far = optics.heads(positions, rotations)
    heads = far.about(middle)
    points, areas, bent = (vertices - middle).float(), area.float(), bending.float()
    pose, vertex = _candidates(optics, points, areas, bent, heads)
    visible = _visible(optics, operators, vertices, sight, pose, vertex, far.emitters, far.ears)
    kept = visible.amax(1) > 0.0
    pose, vertex, visible = pose[kept], vertex[kept], visible[kept]
    return optics.pieces(points, areas, bent, pose, vertex, visible, heads), heads, middle


def _candidates(
    optics: Optics, points: Tensor, area: Tensor, bending: Tensor, heads: Heads
) -> tuple[Tensor, Tensor]:
    """Return pairs of pose and vertex (Q,), (Q,) that could hear each other without obstacles."""
    emitters, middles = heads.emitters, heads.ears.mean(1)
    towards = 0.5 * (emitters + middles)
    facing = towards @ area.T > (points * area).sum(1)
    pose, vertex = torch.nonzero(facing, as_tuple=True)
    exponent = optics.near_mirror(
        points[vertex], area[vertex], bending[vertex], emitters[pose], middles[pose]
    )[4]
    heard = exponent < SILENT
    return pose[heard], vertex[heard]


def _visible(
    optics: Optics,
    operators: MeshOperators,
    vertices: Tensor,
    sight: Occlusion,
    pose: Tensor,
    vertex: Tensor,
    emitters: Tensor,
    ears: Tensor,
) -> Tensor:
    """Visibility of candidates from emitter and ears, (Q, E) float32, softened by neighbours."""
    free = FREE * optics.wavelength
    points = vertices[vertex].detach().cpu().numpy()
    of = pose.cpu().numpy()
    sources, places = emitters.detach().cpu().numpy(), ears.detach().cpu().numpy()
    lit = np.flatnonzero(seen(sight, points, sources[of], free=free))
    clear = np.zeros((len(points), optics.ears), dtype=np.float32)
    for ear in range(optics.ears):
        clear[lit, ear] = seen(sight, points[lit], places[of[lit], ear], free=free)
    visible = torch.as_tensor(clear).to(vertices.device)
    shape = (operators.count, len(emitters), 1 + optics.ears)
    spread = torch.zeros(shape, dtype=torch.float32, device=vertices.device)
    spread[vertex, pose, 0] = 1.0
    spread[vertex, pose, 1:] = visible
    near = operators.averaged(spread.flatten(1)).unflatten(1, shape[1:])[vertex, pose]
    return near[:, 1:] / near[:, :1].clamp_min(1e-6)


class StillSurface:
    """A surface, prepared once for all poses.

    Attributes:
        operators: Operators on the surface.
        vertices, normals, area ((V, 3) float64): Places (m), outward unit normals and vector areas
            (m²).
        bending ((V, 6), 1/m): Curvature, see :meth:`MeshOperators.bending`.
    """

    def __init__(self, mesh: trimesh.Trimesh, optics: Optics) -> None:
        self.optics = optics
        like = optics.get_buffer("wavenumber")
        faces = np.array(mesh.faces, dtype=np.int64)
        self.vertices = torch.as_tensor(np.array(mesh.vertices, dtype=np.float64)).to(like.device)
        self.operators = MeshOperators(torch.as_tensor(faces).to(like.device), len(self.vertices))
        self.area = self.operators.areas(self.vertices)
        self.normals = unit(self.area)
        passes = smoothing_passes(optics.wavelength, self.operators.edge_length(self.vertices))
        self.bending = self.operators.bending(self.vertices, self.normals, passes)
        sight = sight_of(optics, self.vertices.cpu().numpy(), faces)
        self._parts = self.operators, self.vertices, self.area, self.bending, sight

    def listen(self, positions: Floats, rotations: Floats) -> tuple[Pieces, Heads, Tensor]:
        """Return the pieces that poses hear, see :func:`~.visibility.listen`.

        In: positions, rotations ((P, 3), (P, 3, 3)).
        """
        places, turns = (torch.as_tensor(part).to(self.vertices) for part in (positions, rotations))
        return listen(self.optics, *self._parts, places, turns)

    @torch.no_grad()
    def render(
        self,
        positions: Floats,
        rotations: Floats,
        stretch: Floats | float = 1.0,
        late: Floats | float = 0.0,
    ) -> Singles:
        """Return magnitudes on the whole axis, (P, E, R, F).

        In: positions, rotations ((P, 3), (P, 3, 3)).
        """
        optics = self.optics
        shape = (len(positions), optics.ears, optics.rows, len(optics.frequencies))
        magnitudes = np.zeros(shape, dtype=np.float32)
        pieces, heads, middle = self.listen(positions, rotations)
        if not len(pieces.pose):
            return magnitudes
        points, area = (self.vertices - middle).float(), self.area.float()
        factor, more = (points.new_tensor(part).expand(len(magnitudes)) for part in (stretch, late))
        heard = optics.render(points, area, pieces, heads, stretch=factor, late=more)
        magnitude = heard.power.sqrt().cpu().numpy()
        for one, rendered, row in zip(magnitudes, magnitude, heard.row.tolist(), strict=True):
            first, last = max(row, 0), min(row + rendered.shape[1], optics.rows)
            if last > first:
                one[:, first:last] = rendered[:, first - row : last - row]
        return magnitudes
