# SPDX-License-Identifier: MIT
"""Integrals over near triangles, in closed form where the kernel is not smooth.

The kernel is :math:`e^{-jkR} / R`. Its terms :math:`1 / R` and :math:`-k^2 R / 2`, and those of its
normal derivative, are integrated over a triangle in closed form [1]_ [2]_. The remainder is smooth
and does not depend on the distance of the triangles. So one table serves all frequencies.

References:
    .. [1] D. R. Wilton, S. M. Rao, A. W. Glisson, D. H. Schaubert, O. M. Al-Bundak and C. M.
       Butler, "Potential integrals for uniform and linear source distributions on polygonal and
       polyhedral domains", IEEE Transactions on Antennas and Propagation 32, 1984.
    .. [2] R. D. Graglia, "On the numerical integration of the linear shape functions times the 3-D
       Green's function or its gradient on a plane triangle", the same journal 41, 1993.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.sparse import coo_array, csr_array
from scipy.spatial import cKDTree

from sononerf.array_types import Floats, Ints

NEAR = 2.0  # distance of middles over the sum of both radii, below which a pair is near
PAIRS = 1 << 13  # near pairs at a time
# Seven points, exact to degree five (J. Radon 1948): barycentric coordinates and weights.
_A, _B = (6.0 - math.sqrt(15.0)) / 21.0, (6.0 + math.sqrt(15.0)) / 21.0
POINTS = np.array(
    [[1.0 / 3.0] * 3]
    + [np.roll([1.0 - 2.0 * a, a, a], turn).tolist() for a in (_A, _B) for turn in range(3)]
)
WEIGHTS = np.array(
    [9.0 / 40.0]
    + [(155.0 - math.sqrt(15.0)) / 1200.0] * 3
    + [(155.0 + math.sqrt(15.0)) / 1200.0] * 3
)
# The middles of the edges, exact to degree two; row k lies opposite to corner k.
MIDDLES = 0.5 * (1.0 - np.eye(3))


def potentials(corners: Floats, normals: Floats, slopes: Floats, points: Floats) -> Floats:
    r"""Integrate linear functions over triangles, times the singular terms of the kernel.

    With :math:`R` the distance of a point to a place on the triangle and :math:`z` its height
    above the triangle's plane, the functions of the three corners are integrated times
    :math:`1/R`, :math:`R`, :math:`z/R^3` and :math:`z/R`. In the plane itself the third is 0.

    Args:
        corners ((N, 3, 3), m): Corners of the triangles.
        normals (N, 3): Unit vectors.
        slopes ((N, 3, 3), 1/m): Gradients of the corners' functions.
        points ((N, K, 3), m): On none of the edges.

    Returns:
        found (4, N, K, 3): In m, m3, 1 and m2, for each corner.
    """
    away = corners[:, None] - points[:, :, None]  # (N, K, 3, 3): to the corners
    far = np.sqrt(_dot(away, away))
    height = -_dot(away[:, :, 0], normals[:, None])
    edges = corners[:, [1, 2, 0]] - corners
    length = np.sqrt(_dot(edges, edges))
    along = edges / length[:, :, None]
    out = np.cross(along, normals[:, None])  # in the plane, away from the triangle
    start = _dot(away, along[:, None])
    end = start + length[:, None]
    off = _dot(away, out[:, None])
    near, beyond = far, far[:, :, [1, 2, 0]]
    square = off**2 + height[..., None] ** 2
    # This form of ln((R1 + l1) / (R0 + l0)) has no cancellation.
    back = end + start < 0.0
    upper = np.where(back, near - start, beyond + end)
    lower = np.where(back, beyond - end, near + start)
    logs = np.log(upper / np.maximum(lower, 1e-300))
    first = 0.5 * (end * beyond - start * near + square * logs)  # of R along the edge
    third = 0.25 * (end * beyond**3 - start * near**3 + 3.0 * square * first)
    # van Oosterom and Strackee 1983; the sign is that of the height.
    a, b, c = (away[:, :, corner] for corner in range(3))
    below = far.prod(axis=2) + sum(
        _dot(*(away[:, :, other] for other in range(3) if other != corner)) * far[:, :, corner]
        for corner in range(3)
    )
    angle = -2.0 * np.arctan2(_dot(a, np.cross(b, c)), below)
    scale = length.max(axis=1)[:, None]
    angle = np.where(np.abs(height) < 1e-9 * scale, 0.0, angle)
    whole = (off * logs).sum(axis=2) - height * angle
    ways = (height**2 * whole + (off * first).sum(axis=2)) / 3.0
    # The corners' functions below the point, and the contribution of their slopes.
    foot = 1.0 / 3.0 + _dot(slopes[:, None], -away.mean(axis=2)[:, :, None])

    def slope(over: Floats) -> Floats:
        added: Floats = np.einsum("nkd,ncd->nkc", np.einsum("nke,ned->nkd", over, out), slopes)
        return added

    inverse = foot * whole[..., None] + slope(first)
    return np.stack(
        [
            inverse,
            foot * ways[..., None] + slope(third) / 3.0,
            foot * angle[..., None] - height[..., None] * slope(logs),
            height[..., None] * inverse,
        ]
    )


def _dot(a: Floats, b: Floats) -> Floats:
    product: Floats = np.einsum("...d,...d->...", a, b)
    return product


def near_pairs(panels: Panels) -> tuple[Ints, Ints]:
    """Return the pairs (N,), (N,) of triangles that are near each other, themselves included."""
    corners = panels.vertices[panels.faces]
    middles = corners.mean(axis=1)
    radius = np.linalg.norm(corners - middles[:, None], axis=2).max(axis=1)
    tree = cKDTree(middles)
    # Larger triangles search for smaller ones, so that one long triangle does not find all.
    found = tree.query_ball_point(middles, 2.0 * NEAR * radius, return_sorted=False)
    count = np.array([len(some) for some in found])
    one = np.repeat(np.arange(len(found)), count)
    other = np.concatenate(found).astype(np.int64)
    apart = np.linalg.norm(middles[one] - middles[other], axis=1)
    kept = (radius[other] <= radius[one]) & (apart <= NEAR * (radius[one] + radius[other]))
    one, other = one[kept], other[kept]
    key = np.unique(np.concatenate([one * len(found) + other, other * len(found) + one]))
    first, second = np.divmod(key, len(found))
    return first, second


def corrections(panels: Panels) -> tuple[csr_array, ...]:
    r"""Return the correction between near triangles of the quadrature by middles of edges.

    Returns:
        found (five of (V, V)): For the hypersingular operator the terms in :math:`k^0`, :math:`k^2`
            and :math:`k^4`, then those of the double layer in :math:`k^0` and :math:`k^2`, times
            :math:`4 \pi`.
    """
    one, other = near_pairs(panels)
    sums: list[Any] = [0.0] * 5
    shape = len(panels.vertices), len(panels.vertices)
    for start in range(0, len(one), PAIRS):
        some, of = one[start : start + PAIRS], other[start : start + PAIRS]
        kernels = _missing(panels, some, of)  # (4, N, 3, 3)
        curl = [
            np.cross(panels.normals[which][:, None], panels.slopes[which]) for which in (some, of)
        ]
        curls = np.einsum("nad,nbd->nab", *curl)
        cosine = _dot(panels.normals[some], panels.normals[of])[:, None, None]
        inverse, ways = kernels[0], kernels[1]
        terms = (
            -curls * inverse.sum(axis=(1, 2))[:, None, None],
            0.5 * curls * ways.sum(axis=(1, 2))[:, None, None] + cosine * inverse,
            -0.5 * cosine * ways,
            kernels[2],
            0.5 * kernels[3],
        )
        rows = np.repeat(panels.faces[some][:, :, None], 3, axis=2).ravel()
        columns = np.repeat(panels.faces[of][:, None, :], 3, axis=1).ravel()
        for index, term in enumerate(terms):
            sums[index] = sums[index] + csr_array(
                coo_array((term.ravel(), (rows, columns)), shape=shape)
            )
    # The hypersingular operator is symmetric; its quadrature is not quite.
    return tuple(
        csr_array(0.5 * (part + part.T)) if index < 3 else csr_array(part)
        for index, part in enumerate(sums)
    )


def _missing(panels: Panels, one: Ints, other: Ints) -> Floats:
    """Return integrals over pairs of triangles (4, N, 3, 3), minus those by middles of edges."""
    corners = panels.vertices[panels.faces[one]]
    theirs = panels.vertices[panels.faces[other]]
    normals = panels.normals[other]
    points = np.einsum("kc,ncd->nkd", POINTS, corners)
    inner = potentials(theirs, normals, panels.slopes[other], points)
    weights = POINTS * WEIGHTS[:, None]
    exact = np.einsum("ka,jnkb->jnab", weights, inner) * panels.area[one][:, None, None]
    mine = np.einsum("kc,ncd->nkd", MIDDLES, corners)
    away = mine[:, :, None] - np.einsum("kc,ncd->nkd", MIDDLES, theirs)[:, None]
    distance = np.sqrt(_dot(away, away))
    apart = panels.sides[one][:, :, None] != panels.sides[other][:, None, :]
    inverse = np.where(apart, 1.0 / np.where(apart, distance, 1.0), 0.0)
    height = _dot(away, normals[:, None, None])
    kernels = np.stack([inverse, distance, height * inverse**3, height * inverse])
    both = (panels.area[one] * panels.area[other] / 9.0)[:, None, None]
    rough = np.einsum("ka,jnkl,lb->jnab", MIDDLES, kernels, MIDDLES, optimize=True) * both
    found: Floats = exact - rough
    return found


@dataclass(frozen=True, eq=False)
class Panels:
    """A closed surface and its quadrature points, the middles of its edges.

    Attributes:
        vertices ((V, 3), m): Unknowns are the pressures here.
        faces (T, 3): Anticlockwise as seen from outside.
        area ((T,), m2): Area of the triangles.
        normals (T, 3): Outward unit vectors.
        slopes ((T, 3, 3), 1/m): Gradients of the three corners' linear functions.
        ends (Q, 2): Vertices of the edges.
        sides (T, 3): Edge opposite to each corner.
        points ((Q, 3), m): Middles of the edges.
        weights ((Q,), m2): A third of the triangles about an edge.
        vectors ((Q, 3), m2): The same, times their normals.
    """

    vertices: Floats
    faces: Ints
    area: Floats
    normals: Floats
    slopes: Floats
    ends: Ints
    sides: Ints
    points: Floats
    weights: Floats
    vectors: Floats

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
        sums: Floats = onto @ laid
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
