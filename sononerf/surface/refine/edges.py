# SPDX-License-Identifier: MIT
"""Sound from the edges between flat faces, with gradients for the vertices.

A flat face is silent but where it mirrors, and what most poses hear of a body with flat faces is
its edges. They sound as in the simulator (:mod:`sononerf.simulation.diffraction`): each piece of
an edge is a source with the directivity of a rigid wedge. The directivity depends on how the faces
lie, so an edge tells of their tilt from all around, and not only where they mirror.
"""

from __future__ import annotations

import math

import numpy as np
import torch
from torch import Tensor

from sononerf.geometry.meshes import CREASE
from sononerf.geometry.raycast import Occlusion
from sononerf.numerics import Bools, Floats, Ints
from sononerf.simulation.diffraction import wedge_directivity
from sononerf.surface.refine.mesh_operators import unit
from sononerf.surface.refine.optics import Heads, Optics, Paths
from sononerf.surface.refine.visibility import FREE, seen

LIFT = 0.02
"""Height above an edge from which it is seen, shortest wavelengths: more than the rounding of ray
casting, less than anything that is heard."""


class Edges:
    """Edges of a mesh between faces on different planes.

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
        turned = np.einsum("kd,kd->k", np.cross(first, second), end - start)
        cosine = np.einsum("kd,kd->k", first, second)
        sharp = np.flatnonzero((turned > 0.0) & (cosine <= math.cos(CREASE)))
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
    place = (middle + LIFT * optics.wavelength * away)[edge]
    free = FREE * optics.wavelength
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
