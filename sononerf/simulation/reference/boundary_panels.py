# SPDX-License-Identifier: MIT
"""A surface of flat triangles for the boundary-element engine, with its quadrature points."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.sparse import coo_array, csr_array

Reals = NDArray[np.float64]


@dataclass(frozen=True, eq=False)
class Panels:
    """A closed surface and its quadrature points, the middles of its edges.

    Attributes
    ----------
    vertices : (V, 3) float64, m
        Unknowns are the pressures here.
    faces : (T, 3) int64
        Anticlockwise as seen from outside.
    area : (T,) float64, m2
        Of the triangles.
    normals : (T, 3) float64
        Outward unit vectors.
    slopes : (T, 3, 3) float64, 1/m
        Gradients of the three corners' linear functions.
    ends : (Q, 2) int64
        Vertices of the edges.
    sides : (T, 3) int64
        Edge opposite to each corner.
    points : (Q, 3) float64, m
        Middles of the edges.
    weights : (Q,) float64, m2
        A third of the triangles about an edge.
    vectors : (Q, 3) float64, m2
        The same, times their normals.
    """

    vertices: Reals
    faces: NDArray[np.int64]
    area: Reals
    normals: Reals
    slopes: Reals
    ends: NDArray[np.int64]
    sides: NDArray[np.int64]
    points: Reals
    weights: Reals
    vectors: Reals

    @classmethod
    def of(cls, vertices: NDArray[Any], faces: NDArray[Any]) -> Panels:
        """Lay panels over a surface: vertices (V, 3) m, faces (T, 3)."""
        vertices, faces = np.asarray(vertices, np.float64), np.asarray(faces, np.int64)
        corners = vertices[faces]
        opposite = corners[:, [2, 0, 1]] - corners[:, [1, 2, 0]]
        normals = np.cross(opposite[:, 0], opposite[:, 1])
        double = np.linalg.norm(normals, axis=1)
        normals /= double[:, None]
        slopes = np.cross(normals[:, None], opposite) / double[:, None, None]
        pairs = np.sort(faces[:, [[1, 2], [2, 0], [0, 1]]], axis=2).reshape(-1, 2)
        ends, sides = np.unique(pairs, axis=0, return_inverse=True)
        sides = sides.reshape(-1, 3)
        laid = np.concatenate([np.ones((len(faces), 1)), normals], axis=1) / 6.0 * double[:, None]
        onto = csr_array(
            (np.ones(sides.size), (sides.ravel(), np.arange(sides.size) // 3)),
            shape=(len(ends), len(faces)),
        )
        sums: Reals = onto @ laid
        weights, vectors = sums[:, 0], sums[:, 1:]
        points = vertices[ends].mean(axis=1)
        area = double / 2.0
        return cls(vertices, faces, area, normals, slopes, ends, sides, points, weights, vectors)

    @property
    def halves(self) -> csr_array:
        """From vertices to the middles of edges (Q, V)."""
        rows = np.repeat(np.arange(len(self.ends)), 2)
        values = np.full(len(rows), 0.5)
        return csr_array(
            (values, (rows, self.ends.ravel())), shape=(len(self.ends), len(self.vertices))
        )

    @property
    def curls(self) -> list[csr_array]:
        """Integrals of the surface curls, laid onto the edges: three of (Q, V), m."""
        turned = np.cross(self.normals[:, None], self.slopes) * (self.area / 3.0)[:, None, None]
        rows = np.repeat(self.sides[:, :, None], 3, axis=2).ravel()
        columns = np.repeat(self.faces[:, None, :], 3, axis=1).ravel()
        shape = len(self.ends), len(self.vertices)
        found = []
        for axis in range(3):
            values = np.repeat(turned[:, None, :, axis], 3, axis=1).ravel()
            found.append(csr_array(coo_array((values, (rows, columns)), shape=shape)))
        return found

    @property
    def mass(self) -> csr_array:
        """Integrals of the products of two vertices' linear functions (V, V), m2."""
        halves = self.halves
        return csr_array(halves.T @ (self.weights[:, None] * halves))
