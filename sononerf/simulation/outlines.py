# SPDX-License-Identifier: MIT
"""Outlines: the edges of bodies that are seen against the background from some place."""

from __future__ import annotations

import math

import numpy as np
import trimesh

from sononerf.geometry.meshes import CREASE, bodies, corner_normals, weight_gradients
from sononerf.numerics import Bools, Floats, Ints, compiled


class Outlines:
    """Edges of a mesh that may be part of an obstacle's outline, seen from some place.

    Attributes:
        body (T,): Index of each triangle's connected part.
        closed (T,): True if that part has no rim.
        several: True if there are several parts, or one that is not convex.
    """

    def __init__(self, mesh: trimesh.Trimesh) -> None:
        vertices = np.asarray(mesh.vertices, dtype=np.float64)
        faces = np.asarray(mesh.faces, dtype=np.int64)
        pairs = np.asarray(mesh.face_adjacency, dtype=np.int64).reshape(-1, 2)
        used = np.asarray(mesh.edges_sorted)
        _, first, count = np.unique(used, axis=0, return_index=True, return_counts=True)
        rim = first[count == 1]
        owner = np.asarray(mesh.edges_face, dtype=np.int64)[rim]
        self.body: Ints = bodies(mesh)
        parts = int(self.body.max()) + 1
        is_open = np.zeros(parts, dtype=bool)
        is_open[self.body[owner]] = True
        self.closed: Bools = ~is_open[self.body]
        ends = np.concatenate([np.asarray(mesh.face_adjacency_edges).reshape(-1, 2), used[rim]])
        self._ends = vertices[ends]
        self._normals = np.asarray(mesh.face_normals, dtype=np.float64)
        self._height = np.einsum("td,td->t", self._normals, vertices[faces[:, 0]])
        self._pairs = np.concatenate([pairs, np.stack([owner, owner], axis=1)])
        self._rim = np.arange(len(self._pairs)) >= len(pairs)
        self._middles = vertices[faces].mean(axis=1)
        convex = np.asarray(mesh.face_adjacency_convex, dtype=bool)
        normals = corner_normals(mesh)
        self._second, self._third = weight_gradients(vertices[faces])
        self._bend = normals[:, 1:] - normals[:, :1]
        sharp = np.asarray(mesh.face_adjacency_angles) >= CREASE
        self._sharp = np.concatenate([sharp, np.ones(len(rim), dtype=bool)])
        self._size = float(np.linalg.norm(vertices.max(axis=0) - vertices.min(axis=0)))
        self.bounds = vertices.min(axis=0), vertices.max(axis=0)
        self._may = np.concatenate(
            [convex | ~self.closed[pairs[:, 0]], np.ones(len(rim), dtype=bool)]
        )
        self.several = parts > 1 or bool(is_open.any()) or not mesh.is_convex

    def seen_from(self, place: Floats) -> tuple[Floats, Floats, Ints, Floats]:
        """Return outline edges as seen from a place.

        Out: ends ((K, 2, 3), m), away (K, 3), body (K,), radius ((K,), m).
        """
        return _outline(
            place, self._normals, self._height, self._pairs, self._may, self._rim, self._sharp,
            self._ends, self._middles, self._second, self._third, self._bend, self.body,
            1.0 / self._size,
        )  # fmt: skip


@compiled
def _outline(
    place: Floats,
    normals: Floats,
    height: Floats,
    pairs: Ints,
    may: Bools,
    rims: Bools,
    sharp: Bools,
    edges: Floats,
    middles: Floats,
    second: Floats,
    third: Floats,
    bend: Floats,
    bodies: Ints,
    least: float,
) -> tuple[Floats, Floats, Ints, Floats]:
    """Return the edges between a triangle that faces a place and one that does not, and rims.

    In: place ((3,), m), normals (T, 3), height ((T,), m), pairs (K, 2), may, rims, sharp (K,),
    edges ((K, 2, 3), m), middles ((T, 3), m), second, third ((T, 3), 1/m), bend (T, 2, 3), bodies
    (T,), least (1/m).
    """
    front = np.zeros(len(normals), np.bool_)
    for i in range(len(normals)):
        n = normals[i]
        front[i] = n[0] * place[0] + n[1] * place[1] + n[2] * place[2] > height[i]
    count = 0
    for e in range(len(pairs)):
        if may[e] and (rims[e] or front[pairs[e, 0]] != front[pairs[e, 1]]):
            count += 1
    ends, away = np.zeros((count, 2, 3)), np.zeros((count, 3))
    body, radius = np.zeros(count, np.int64), np.zeros(count)
    a, b, inward, along = np.zeros(3), np.zeros(3), np.zeros(3), np.zeros(3)
    i = 0
    for e in range(len(pairs)):
        one, two = pairs[e, 0], pairs[e, 1]
        if not (may[e] and (rims[e] or front[one] != front[two])):
            continue
        facing = one if front[one] else two
        for k in range(3):
            a[k], b[k] = edges[e, 0, k], edges[e, 1, k]
            inward[k] = middles[facing, k] - a[k]
            along[k] = b[k] - a[k]
        turned = (along[1] * inward[2] - along[2] * inward[1]) * (place[0] - a[0])
        turned += (along[2] * inward[0] - along[0] * inward[2]) * (place[1] - a[1])
        turned += (along[0] * inward[1] - along[1] * inward[0]) * (place[2] - a[2])
        square, product, length, far = 0.0, 0.0, 0.0, 0.0
        for k in range(3):
            ends[i, 0, k], ends[i, 1, k] = (b[k], a[k]) if turned < 0.0 else (a[k], b[k])
            square += along[k] * along[k]
            product += along[k] * inward[k]
        for k in range(3):
            if rims[e]:
                away[i, k] = product / max(square, 1e-300) * along[k] - inward[k]
            else:
                away[i, k] = normals[one, k] + normals[two, k]
            length += away[i, k] * away[i, k]
            along[k] = 0.5 * (a[k] + b[k]) - place[k]
            far += along[k] * along[k]
        length, far = math.sqrt(length), math.sqrt(far)
        bent = 0.0
        for triangle in (one, two):
            share, other = 0.0, 0.0
            for k in range(3):
                share += second[triangle, k] * along[k] / far
                other += third[triangle, k] * along[k] / far
            for k in range(3):
                turn = share * bend[triangle, 0, k] + other * bend[triangle, 1, k]
                bent += 0.5 * turn * along[k] / far
        for k in range(3):
            away[i, k] /= max(length, 1e-300)
        body[i] = bodies[facing]
        if not sharp[e]:
            radius[i] = 1.0 / max(bent, least)
        i += 1
    return ends, away, body, radius
