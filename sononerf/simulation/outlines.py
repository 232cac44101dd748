# SPDX-License-Identifier: MIT
"""The outlines of bodies as a place sees them."""

from __future__ import annotations

import numpy as np
import trimesh
from numpy.typing import NDArray

from sononerf.geometry.normals import CREASE, bodies, corner_normals, weight_gradients


class Outlines:
    """The edges of a mesh that may be the outline of an obstacle, seen from somewhere.

    Args:
        mesh: The scene.

    Attributes:
        body (T,): Which connected part a triangle belongs to.
        closed (T,): Whether that part has no rim.
        several: Whether there is more than one part, or any that is not convex.
    """

    def __init__(self, mesh: trimesh.Trimesh) -> None:
        vertices = np.asarray(mesh.vertices, dtype=np.float64)
        faces = np.asarray(mesh.faces, dtype=np.int64)
        pairs = np.asarray(mesh.face_adjacency, dtype=np.int64).reshape(-1, 2)
        used = np.asarray(mesh.edges_sorted)
        _, first, count = np.unique(used, axis=0, return_index=True, return_counts=True)
        rim = first[count == 1]
        owner = np.asarray(mesh.edges_face, dtype=np.int64)[rim]
        self.body: NDArray[np.int64] = bodies(mesh)
        parts = int(self.body.max()) + 1
        is_open = np.zeros(parts, dtype=bool)
        is_open[self.body[owner]] = True
        self.closed: NDArray[np.bool_] = ~is_open[self.body]
        ends = np.concatenate([np.asarray(mesh.face_adjacency_edges).reshape(-1, 2), used[rim]])
        self._normals = np.asarray(mesh.face_normals, dtype=np.float64)
        self._height = np.einsum("td,td->t", self._normals, vertices[faces[:, 0]])
        self._pairs = np.concatenate([pairs, np.stack([owner, owner], axis=1)])
        self._rim = np.arange(len(self._pairs)) >= len(pairs)
        self._ends, self._vertices = ends, vertices
        self._middles = vertices[faces].mean(axis=1)
        convex = np.asarray(mesh.face_adjacency_convex, dtype=bool)
        normals = corner_normals(mesh)
        self._second, self._third = weight_gradients(vertices[faces])
        self._bend = normals[:, 1:] - normals[:, :1]
        sharp = np.asarray(mesh.face_adjacency_angles) >= CREASE
        self._sharp = np.concatenate([sharp, np.ones(len(rim), dtype=bool)])
        self._size = float(np.linalg.norm(vertices.max(axis=0) - vertices.min(axis=0)))
        self.bounds = vertices.min(axis=0), vertices.max(axis=0)
        self._outward = np.concatenate(
            [convex | ~self.closed[pairs[:, 0]], np.ones(len(rim), dtype=bool)]
        )
        self.several = parts > 1 or bool(is_open.any()) or not mesh.is_convex

    def seen_from(
        self, place: NDArray[np.float64]
    ) -> tuple[NDArray[np.float64], NDArray[np.float64], NDArray[np.int64], NDArray[np.float64]]:
        """Return outline edges as seen from a place.

        Returns:
            ends ((K, 2, 3), m): The obstacle lies on the left as one goes from the first to the
                second.
            away (K, 3): Unit vectors off the surface.
            body (K,): Of each edge.
            radius ((K,), m): Of the surface's curvature along the way from the place; zero where it
                is sharp.
        """
        front = self._normals @ place > self._height
        one, two = self._pairs.T
        chosen = np.flatnonzero(((front[one] != front[two]) | self._rim) & self._outward)
        one, two = one[chosen], two[chosen]
        facing = np.where(front[one], one, two)
        ends = self._vertices[self._ends[chosen]]
        inward = self._middles[facing] - ends[:, 0]
        left = np.cross(ends[:, 1] - ends[:, 0], inward)
        turned = np.einsum("kd,kd->k", left, place - ends[:, 0]) < 0.0
        ends[turned] = ends[turned, ::-1]
        away = self._normals[one] + self._normals[two]
        rim = self._rim[chosen]
        along = ends[rim, 1] - ends[rim, 0]
        square = np.einsum("kd,kd->k", along, along)
        square = np.einsum("kd,kd->k", along, inward[rim]) / np.maximum(square, 1e-300)
        away[rim] = square[:, None] * along - inward[rim]
        length = np.linalg.norm(away, axis=1, keepdims=True)
        radius = self._radius(one, two, ends.mean(axis=1) - place)
        radius[self._sharp[chosen]] = 0.0
        return ends, away / np.maximum(length, 1e-300), self.body[facing], radius

    def _radius(
        self, one: NDArray[np.int64], two: NDArray[np.int64], along: NDArray[np.float64]
    ) -> NDArray[np.float64]:
        """Radius of curvature along a direction, the mean of two triangles."""
        along = along / np.linalg.norm(along, axis=1, keepdims=True)
        bend = np.zeros(len(one))
        for triangle in (one, two):
            turn = np.zeros_like(along)
            for corner, gradient in enumerate((self._second, self._third)):
                share = np.einsum("kd,kd->k", gradient[triangle], along)
                turn += share[:, None] * self._bend[triangle, corner]
            bend += 0.5 * np.einsum("kd,kd->k", turn, along)
        return 1.0 / np.maximum(bend, 1.0 / self._size)
