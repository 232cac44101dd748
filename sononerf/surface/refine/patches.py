# SPDX-License-Identifier: MIT
"""Flat parts of a surface as patches with few numbers, which meet in sharp edges.

Off the mirror a flat face is silent, and a wave of a two-hundredth of a wavelength on it is as loud
as its edges. So vertices that move freely never find one. A plane has three numbers; the error
falls steadily towards the true ones, from a wavelength away. Real faces are bent a little: three
more numbers make a patch a paraboloid.

A vertex lies on the patches of all triangles about it: on one, on an edge of two, or on a corner.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import trimesh
from scipy.sparse import csr_array

from sononerf.numerics import Floats, Ints
from sononerf.surface.refine.planes import planes_of, summed

PARALLEL = 0.05
"""Eigenvalue of the sum of the normals' outer products below which patches do not determine where
they meet, no unit: that of two planes at 18 degrees."""
SOFT = 0.02
"""Added to these eigenvalues where patches move, no unit: vertices between planes that are nearly
parallel then move by little, and not far along them."""
EVEN = 20
"""Number of steps that make the triangles even again."""
BENT = 2.0
"""Distance from the middle up to which patches bend, root mean squares of the part along that axis:
a rectangle ends at 1.7."""
SQUARE = 0.8**0.5
"""Root mean square of u^2 - 1 over a rectangle, no unit."""
FITS = 3
"""Number of fits of a bent patch; what is far off the one before counts little."""


@dataclass(frozen=True, eq=False)
class Patches:
    """Heights over planes, as polynomials of degree 2 or less."""

    centre: Floats  # (N, 3), m: Origins of the planes
    axes: Floats  # (N, 3, 3): Two unit vectors along each plane, and its outward normal
    scale: Floats  # (N, 2), m: Root mean squares of the parts along the first two
    numbers: Floats  # (N, 6), m: Factors of the terms of :meth:`terms`

    def terms(self, of: Ints, places: Floats) -> Floats:
        """Return 1, u, v, u^2 - 1, u v and v^2 - 1 of places (M, 3), m, on patches (M,), as (M, 6).

        The mean square of each is about one over the patch; beyond it nothing bends any more.
        """
        u, v, _ = self._along(of, places).T
        a, b = np.clip(u, -BENT, BENT), np.clip(v, -BENT, BENT)
        first, second = (2.0 * u - a) * a - 1.0, (2.0 * v - b) * b - 1.0
        return np.stack([np.ones(len(u)), u, v, first / SQUARE, a * b, second / SQUARE], axis=1)

    def off(self, of: Ints, places: Floats) -> Floats:
        """Return the heights (M,) of places (M, 3) above patches (M,), m."""
        height: Floats = self._along(of, places)[:, 2]
        return height - (self.numbers[of] * self.terms(of, places)).sum(1)

    def normals(self, of: Ints, places: Floats) -> Floats:
        """Return the outward unit normals (M, 3) of patches (M,) at places (M, 3), m."""
        u, v, _ = self._along(of, places).T
        a, b = np.clip(u, -BENT, BENT), np.clip(v, -BENT, BENT)
        _, *tilt, first, both, second = self.numbers[of].T
        slope = [2.0 * first / SQUARE * a + both * b * (u == a)]
        slope += [2.0 * second / SQUARE * b + both * a * (v == b)]
        along = (np.stack(tilt, axis=1) + np.stack(slope, axis=1)) / self.scale[of]
        axes = self.axes[of]
        found = axes[:, 2] - along[:, :1] * axes[:, 0] - along[:, 1:] * axes[:, 1]
        return found / np.linalg.norm(found, axis=1, keepdims=True)

    def _along(self, of: Ints, places: Floats) -> Floats:
        """Return scaled coordinates along the planes and heights above them (M, 3)."""
        found = np.einsum("mij,mj->mi", self.axes[of], places - self.centre[of])
        found[:, :2] /= self.scale[of]
        return found


def patches_of(mesh: trimesh.Trimesh, part: Ints, tolerance: float, *, bent: bool) -> Patches:
    """Return the patches of parts; what is far off them, such as a rounded edge, counts little.

    In: part (T,), tolerance (m).
    """
    normal, offset = planes_of(mesh, part, tolerance)
    count, area = len(normal), np.asarray(mesh.area_faces)
    middle = np.asarray(mesh.triangles_center)
    whole = np.maximum(np.bincount(part, area, count), 1e-300)[:, None]
    centre = summed(part, area[:, None] * middle, count) / whole
    centre -= ((centre * normal).sum(1) - offset)[:, None] * normal
    away = middle - centre[part]
    away -= (away * normal[part]).sum(1)[:, None] * normal[part]
    square = (area[:, None, None] * away[:, :, None] * away[:, None]).reshape(-1, 9)
    size, axes = np.linalg.eigh((summed(part, square, count) / whole).reshape(-1, 3, 3))
    first = np.cross(axes[:, :, 2], normal)
    first = np.cross(normal, first)
    first /= np.maximum(np.linalg.norm(first, axis=1, keepdims=True), 1e-300)
    frame = np.stack([first, np.cross(normal, first), normal], axis=1)
    scale = np.maximum(np.sqrt(np.maximum(size[:, :0:-1], 0.0)), tolerance)
    flat = Patches(centre, frame, scale, np.zeros((count, 6)))
    return _bent(mesh, part, flat, tolerance) if bent else flat


def on_patches(
    mesh: trimesh.Trimesh, part: Ints, patches: Patches, home: Floats, far: float
) -> trimesh.Trimesh:
    """Return a mesh with each part on its patch, and sharp edges where patches meet.

    In: part (T,), home ((V, 3), m), far (m).
    """
    vertex, patch = members(np.asarray(mesh.faces), part)
    count = len(mesh.vertices)
    number = np.bincount(vertex, minlength=count)
    shared = number[vertex] > 1  # by several patches; the other vertices lie on one
    edge = np.flatnonzero(number > 1)
    at = np.searchsorted(edge, vertex[shared])

    def put(places: Floats) -> Floats:
        """Return the places after a step of Gauss and Newton towards all of their patches."""
        upright = patches.normals(patch, places[vertex])
        short = -patches.off(patch, places[vertex])[:, None] * upright
        moved = places.copy()
        moved[vertex[~shared]] += short[~shared]
        size, axes = np.linalg.eigh(_squares(at, upright[shared], len(edge)))
        inverse = np.where(size > PARALLEL, 1.0 / np.maximum(size, PARALLEL), 0.0)
        inverse = (axes * inverse[:, None]) @ axes.transpose(0, 2, 1)
        moved[edge] += np.einsum("vij,vj->vi", inverse, summed(at, short[shared], len(edge)))
        away = moved[edge] - home[edge]
        length = np.linalg.norm(away, axis=1, keepdims=True)
        moved[edge] = home[edge] + away * np.minimum(1.0, far / np.maximum(length, 1e-300))
        return moved

    # Each vertex goes half-way to the mean of the neighbours that lie on all of its patches.
    own = csr_array((np.ones(len(vertex)), (vertex, patch)), shape=(count, len(patches.centre)))
    ends = np.asarray(mesh.edges_unique)
    common = np.asarray(own[ends[:, 0]].multiply(own[ends[:, 1]]).sum(axis=1)).ravel()
    pairs = np.concatenate(
        [ends[common == number[ends[:, 0]]], ends[common == number[ends[:, 1]], ::-1]]
    )
    near = csr_array((np.ones(len(pairs)), pairs.T), shape=(count, count))
    degree = near.sum(axis=1)[:, None]
    places = put(np.asarray(mesh.vertices, dtype=np.float64))
    for _ in range(EVEN):
        mean = np.where(degree > 0, (near @ places) / np.maximum(degree, 1), places)
        places = put(0.5 * (places + mean))
    return trimesh.Trimesh(places, np.asarray(mesh.faces), process=False)


def motions(vertices: Floats, faces: Ints, part: Ints, patches: Patches, terms: int) -> csr_array:
    """Return how the vertices move with the numbers of their patches.

    In: vertices ((V, 3), m), faces (T, 3), part (T,). Out: motion (3 V, K N).
    """
    vertex, patch = members(faces, part)
    upright = patches.normals(patch, vertices[vertex])
    inverse = np.linalg.inv(_squares(vertex, upright, len(vertices)) + SOFT * np.eye(3))
    moved = np.einsum("mij,mj->mi", inverse[vertex], upright)
    values = moved[:, :, None] * patches.terms(patch, vertices[vertex])[:, None, :terms]
    rows = (3 * vertex)[:, None, None] + np.arange(3)[:, None] + np.zeros(terms, dtype=np.int64)
    columns = (terms * patch)[:, None, None] + np.zeros((3, 1), np.int64) + np.arange(terms)
    shape = (3 * len(vertices), terms * len(patches.centre))
    return csr_array((values.ravel(), (rows.ravel(), columns.ravel())), shape=shape)


def members(faces: Ints, part: Ints) -> tuple[Ints, Ints]:
    """Return vertices and their patches (M,), each pair once."""
    both = np.unique(np.stack([faces.ravel(), np.repeat(part, 3)], axis=1), axis=0)
    return both[:, 0], both[:, 1]


def _squares(vertex: Ints, upright: Floats, count: int) -> Floats:
    """Sum of the normals' outer products by vertices, (V, 3, 3)."""
    square = (upright[:, :, None] * upright[:, None]).reshape(-1, 9)
    return summed(vertex, square, count).reshape(-1, 3, 3)


def _bent(mesh: trimesh.Trimesh, part: Ints, flat: Patches, tolerance: float) -> Patches:
    """Return the patches that fit the parts best."""
    middle, area = np.asarray(mesh.triangles_center), np.asarray(mesh.area_faces)
    upright, count = np.asarray(mesh.face_normals), len(flat.centre)
    terms, height = flat.terms(part, middle), flat.off(part, middle)
    patches = flat
    for _ in range(FITS):
        cosine = (upright * patches.normals(part, middle)).sum(1)
        tilt = np.clip((cosine - 0.7) / 0.3, 0.01, 1.0)
        weight = area * tilt**2 / (1.0 + np.square(patches.off(part, middle) / tolerance))
        whole = np.maximum(np.bincount(part, weight, count), 1e-300)
        weight = weight / whole[part]
        square = (weight[:, None, None] * terms[:, :, None] * terms[:, None]).reshape(-1, 36)
        matrix = summed(part, square, count).reshape(-1, 6, 6) + 1e-3 * np.eye(6)
        wanted = summed(part, (weight * height)[:, None] * terms, count)
        numbers = np.linalg.solve(matrix, wanted[:, :, None])[:, :, 0].astype(np.float64)
        patches = Patches(flat.centre, flat.axes, flat.scale, numbers)
    return patches
