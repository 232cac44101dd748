# SPDX-License-Identifier: MIT
"""Visibility of a surface from emitter and ears, and its rendering."""

from __future__ import annotations

import numpy as np
import torch
from torch import Tensor

from sononerf.array_types import Bools, Floats, Ints
from sononerf.geometry.raycast import Occlusion
from sononerf.surface.refine.mesh_operators import MeshOperators
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
    optics: Optics,
    points: Tensor,
    area: Tensor,
    bending: Tensor,
    heads: Heads,
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
    found = torch.as_tensor(clear).to(vertices.device)
    shape = (operators.count, len(emitters), 1 + optics.ears)
    spread = torch.zeros(shape, dtype=torch.float32, device=vertices.device)
    spread[vertex, pose, 0] = 1.0
    spread[vertex, pose, 1:] = found
    near = operators.averaged(spread.flatten(1)).unflatten(1, shape[1:])[vertex, pose]
    return near[:, 1:] / near[:, :1].clamp_min(1e-6)
