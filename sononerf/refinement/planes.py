# SPDX-License-Identifier: MIT
"""Flat parts of a surface, found by hierarchical clustering of its triangles [1]_.

References:
    .. [1] M. Garland, A. Willmott and P. S. Heckbert, "Hierarchical face clustering on polygonal
       surfaces", I3D 2001.
"""

from __future__ import annotations

import heapq
import math
from dataclasses import dataclass

import numpy as np
import trimesh
from scipy.sparse import csr_array

from sononerf.numerics import Floats, Ints, compiled

MIN_COHERENCE = 0.9
"""Least length of the mean of a part's unit normals, no unit. The two sides of a thin plate have a
mean of zero, so they stay apart."""
NEIGHBOUR_GAIN = 0.3
"""What a triangle gains by each neighbour of the same part, no unit; its cost is the square of its
distance from the plane over the tolerance."""
TILT_COST = 0.5
"""Further cost of a triangle whose normal is square to that of the plane, no unit."""
MAX_SWEEPS = 15
"""Number of times that triangles are given to the plane that fits them best, at most."""


def flat_parts(mesh: trimesh.Trimesh, tolerance: float, least: float) -> Ints:
    """Return the number of the flat part (T,) that each triangle belongs to.

    In: tolerance (m), least (m²).
    """
    corners = np.asarray(mesh.triangles, dtype=np.float64)
    pairs = np.asarray(mesh.face_adjacency, dtype=np.int64)
    part = _clustered(*_moments(corners), pairs, tolerance**2, MIN_COHERENCE)
    part = _given_to_the_best(mesh, _counted(part), tolerance)
    area = np.bincount(part, mesh.area_faces)
    normal, offset = planes_of(mesh, part, tolerance)
    for number in sorted(np.flatnonzero(area < least), key=lambda one: area[one]):
        own = part == number
        beside = np.unique(part[pairs[own[pairs].any(axis=1)]])
        beside = beside[beside != number]
        if len(beside):
            off = mesh.triangles_center[own] @ normal[beside].T - offset[beside]
            part[own] = beside[np.abs(off).mean(axis=0).argmin()]
    return _counted(_given_to_the_best(mesh, _counted(part), tolerance))


def planes_of(mesh: trimesh.Trimesh, part: Ints, tolerance: float) -> tuple[Floats, Floats]:
    """Return the planes of parts; what is far off them, such as a rounded edge, counts little.

    In: part (T,), tolerance (m). Out: normal (N, 3), offset ((N,), m).
    """
    middle, area = np.asarray(mesh.triangles_center), np.asarray(mesh.area_faces)
    upright = np.asarray(mesh.face_normals)
    count, weight = int(part.max()) + 1, area
    normal, offset = np.zeros((count, 3)), np.zeros(count)
    outward = summed(part, area[:, None] * upright, count)
    for _ in range(9):
        whole = np.maximum(np.bincount(part, weight, count), 1e-300)
        centre = summed(part, weight[:, None] * middle, count) / whole[:, None]
        off = middle - centre[part]
        square = (weight[:, None, None] * off[:, :, None] * off[:, None]).reshape(-1, 9)
        spread = summed(part, square, count).reshape(-1, 3, 3)
        normal = np.linalg.eigh(spread)[1][:, :, 0]
        normal *= np.where((normal * outward).sum(1) < 0.0, -1.0, 1.0)[:, None]
        offset = (normal * centre).sum(1)
        away = (middle * normal[part]).sum(1) - offset[part]
        tilt = np.clip(((upright * normal[part]).sum(1) - 0.7) / 0.3, 0.01, 1.0)
        weight = area * tilt**2 / (1.0 + np.square(away / tolerance))
    return normal, offset


def _given_to_the_best(mesh: trimesh.Trimesh, part: Ints, tolerance: float) -> Ints:
    """Give triangles at borders to the part on whose plane they lie best, of those beside them."""
    pairs = np.asarray(mesh.face_adjacency)
    middle, upright = np.asarray(mesh.triangles_center), np.asarray(mesh.face_normals)
    beside = np.repeat(np.arange(len(part))[:, None], 3, axis=1)
    both = np.concatenate([pairs, pairs[:, ::-1]])
    both = both[np.argsort(both[:, 0], kind="stable")]
    rank = np.arange(len(both)) - np.searchsorted(both[:, 0], both[:, 0])
    inner = rank < 3
    beside[both[inner, 0], rank[inner]] = both[inner, 1]
    for _ in range(2):
        normal, offset = planes_of(mesh, part, tolerance)
        for sweep in range(MAX_SWEEPS):
            choice = np.concatenate([part[:, None], part[beside]], axis=1)
            off = np.einsum("td,tcd->tc", middle, normal[choice]) - offset[choice]
            tilt = 1.0 - np.einsum("td,tcd->tc", upright, normal[choice])
            like = (choice[:, :, None] == part[beside][:, None]).sum(axis=2)
            cost = np.square(off / tolerance) + TILT_COST * tilt - NEIGHBOUR_GAIN * like
            best = choice[np.arange(len(part)), cost.argmin(axis=1)]
            # Half of them at a time, so that neighbours do not change places for ever.
            best = np.where(np.arange(len(part)) % 2 == sweep % 2, best, part)
            if sweep and (best == part).all():
                break
            part = best
        part = _counted(part)
    return part


def _counted(part: Ints) -> Ints:
    """Return the parts with numbers from 0 on."""
    return np.unique(part, return_inverse=True)[1].reshape(-1)


def summed(of: Ints, values: Floats, count: int) -> Floats:
    """Sum of rows (N, K) by their numbers (N,), (count, K)."""
    columns = [np.bincount(of, column, count) for column in values.T]
    return np.stack(columns, axis=1)


def _moments(corners: Floats) -> tuple[Floats, Floats, Floats, Floats]:
    """Area (T,), first (T, 3) and second (T, 3, 3) moments, and vector area (T, 3) of triangles."""
    vector = 0.5 * np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    area = np.linalg.norm(vector, axis=1)
    middle = corners.mean(axis=1)
    square = (
        np.einsum("tci,tcj->tij", corners, corners) + 9.0 * middle[:, :, None] * middle[:, None]
    )
    return area, area[:, None] * middle, area[:, None, None] / 12.0 * square, vector


@compiled
def _flatness(area: float, first: Floats, second: Floats) -> float:
    """Mean square of the distance from the best plane, m²: the least eigenvalue."""
    xx = second[0, 0] / area - (first[0] / area) ** 2
    yy = second[1, 1] / area - (first[1] / area) ** 2
    zz = second[2, 2] / area - (first[2] / area) ** 2
    xy = second[0, 1] / area - first[0] * first[1] / area**2
    xz = second[0, 2] / area - first[0] * first[2] / area**2
    yz = second[1, 2] / area - first[1] * first[2] / area**2
    mean = (xx + yy + zz) / 3.0
    p = (xx - mean) ** 2 + (yy - mean) ** 2 + (zz - mean) ** 2
    p = math.sqrt((p + 2.0 * (xy * xy + xz * xz + yz * yz)) / 6.0)
    if p <= 0.0:
        return max(mean, 0.0)
    a, b, c = (xx - mean) / p, (yy - mean) / p, (zz - mean) / p
    d, e, f = xy / p, xz / p, yz / p
    half = 0.5 * (a * (b * c - f * f) - d * (d * c - f * e) + e * (d * f - b * e))
    angle = math.acos(min(max(half, -1.0), 1.0)) / 3.0
    return max(mean + 2.0 * p * math.cos(angle + 2.0 * math.pi / 3.0), 0.0)


@compiled
def _cost(
    one: int,
    other: int,
    area: Floats,
    first: Floats,
    second: Floats,
    vector: Floats,
    most: float,
    coherent: float,
) -> float:
    """Cost of making two parts one, m⁴; -1 if they do not lie on one plane."""
    whole = max(area[one] + area[other], 1e-300)
    mean = vector[one] + vector[other]
    length = math.sqrt(mean[0] ** 2 + mean[1] ** 2 + mean[2] ** 2) / whole
    off = _flatness(whole, first[one] + first[other], second[one] + second[other])
    if off > most or length < coherent:
        return -1.0
    return (off + (1.0 - length) * most) * whole


@compiled
def _clustered(
    area: Floats,
    first: Floats,
    second: Floats,
    vector: Floats,
    pairs: Ints,
    most: float,
    coherent: float,
) -> Ints:
    """Merge neighbouring triangles, those first that lie best on one plane; return roots (T,).

    Arguments are :func:`_moments`, pairs of neighbours (K, 2), the largest mean square of the
    distance from the plane, m², and the least length of a mean normal.
    """
    count = len(area)
    root = np.arange(count)
    version = np.zeros(count, dtype=np.int64)
    # Chains of each part's pairs: pair k stands in the chain of its first triangle as 2 k, and in
    # that of its second one as 2 k + 1.
    head = np.full(count, -1)
    tail = np.full(count, -1)
    after = np.full(2 * len(pairs), -1)
    mark = np.full(count, -1)
    for place in range(2 * len(pairs)):
        of = pairs[place // 2, place % 2]
        after[place] = head[of]
        if head[of] < 0:
            tail[of] = place
        head[of] = place
    heap = [(0.0, 0, 0, 0, 0)]
    heap.pop()
    for pair in pairs:
        one, other = pair[0], pair[1]
        cost = _cost(one, other, area, first, second, vector, most, coherent)
        if cost >= 0.0:
            heapq.heappush(heap, (cost, one, other, 0, 0))
    merges = 0
    while len(heap) > 0:
        _, one, other, old, older = heapq.heappop(heap)
        if version[one] != old or version[other] != older:
            continue
        area[one] += area[other]
        first[one] += first[other]
        second[one] += second[other]
        vector[one] += vector[other]
        root[other] = one
        version[one] += 1
        version[other] = -1
        if head[one] < 0:
            head[one] = head[other]
        elif head[other] >= 0:
            after[tail[one]] = head[other]
        if head[other] >= 0:
            tail[one] = tail[other]
        merges += 1
        place, before = head[one], -1
        while place >= 0:
            following = after[place]
            beside = pairs[place // 2, 1 - place % 2]
            while root[beside] != beside:
                root[beside] = root[root[beside]]
                beside = root[beside]
            if beside != one:
                before = place
            elif before >= 0:  # the pair lies inside now, and leaves the chain
                after[before] = following
            else:
                head[one] = following
            if following < 0:
                tail[one] = before
            if beside != one and mark[beside] != merges:
                mark[beside] = merges
                cost = _cost(one, beside, area, first, second, vector, most, coherent)
                if cost >= 0.0:
                    heapq.heappush(heap, (cost, one, beside, version[one], version[beside]))
            place = following
    for number in range(count):
        at = number
        while root[at] != at:
            at = root[at]
        root[number] = at
    return root


MIN_EIGENVALUE = 0.05
"""Eigenvalue of the sum of the normals' outer products below which patches do not determine where
they meet, no unit: that of two planes at 18 degrees."""
EIGENVALUE_FLOOR = 0.02
"""Added to these eigenvalues where patches move, no unit: vertices between planes that are nearly
parallel then move by little, and not far along them."""
EVEN_STEPS = 20
"""Number of steps that make the triangles even again."""
MAX_BEND_RADIUS = 2.0
"""Distance from the middle up to which patches bend, root mean squares of the part along that axis:
a rectangle ends at 1.7."""
SQUARE = 0.8**0.5
"""Root mean square of u^2 - 1 over a rectangle, no unit."""
PATCH_FITS = 3
"""Number of fits of a bent patch; what is far off the one before counts little."""


@dataclass(frozen=True, eq=False)
class Patches:
    """Heights over planes, as polynomials of degree 2 or less.

    Off the mirror a flat face is silent, and a wave of a two-hundredth of a wavelength on it is as
    loud as its edges, so vertices that move freely never find one. A plane has three numbers, and
    the error falls steadily towards the true ones. Three more numbers bend it to a paraboloid.
    """

    centre: Floats  # (N, 3), m: Origins of the planes
    axes: Floats  # (N, 3, 3): Two unit vectors along each plane, and its outward normal
    scale: Floats  # (N, 2), m: Root mean squares of the parts along the first two
    numbers: Floats  # (N, 6), m: Factors of the terms of :meth:`terms`

    def terms(self, of: Ints, places: Floats) -> Floats:
        """Return 1, u, v, u^2 - 1, u v and v^2 - 1 of places (M, 3), m, on patches (M,), as (M, 6).

        The mean square of each is about one over the patch; beyond it nothing bends any more.
        """
        u, v, _ = self._along(of, places).T
        a, b = (
            np.clip(u, -MAX_BEND_RADIUS, MAX_BEND_RADIUS),
            np.clip(v, -MAX_BEND_RADIUS, MAX_BEND_RADIUS),
        )
        first, second = (2.0 * u - a) * a - 1.0, (2.0 * v - b) * b - 1.0
        return np.stack([np.ones(len(u)), u, v, first / SQUARE, a * b, second / SQUARE], axis=1)

    def off(self, of: Ints, places: Floats) -> Floats:
        """Return the heights (M,) of places (M, 3) above patches (M,), m."""
        height: Floats = self._along(of, places)[:, 2]
        return height - (self.numbers[of] * self.terms(of, places)).sum(1)

    def normals(self, of: Ints, places: Floats) -> Floats:
        """Return the outward unit normals (M, 3) of patches (M,) at places (M, 3), m."""
        u, v, _ = self._along(of, places).T
        a, b = (
            np.clip(u, -MAX_BEND_RADIUS, MAX_BEND_RADIUS),
            np.clip(v, -MAX_BEND_RADIUS, MAX_BEND_RADIUS),
        )
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
        inverse = np.where(size > MIN_EIGENVALUE, 1.0 / np.maximum(size, MIN_EIGENVALUE), 0.0)
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
    for _ in range(EVEN_STEPS):
        mean = np.where(degree > 0, (near @ places) / np.maximum(degree, 1), places)
        places = put(0.5 * (places + mean))
    return trimesh.Trimesh(places, np.asarray(mesh.faces), process=False)


def motions(vertices: Floats, faces: Ints, part: Ints, patches: Patches, terms: int) -> csr_array:
    """Return the derivatives of the vertices by the numbers of their patches.

    In: vertices ((V, 3), m), faces (T, 3), part (T,). Out: motion (3 V, K N).
    """
    vertex, patch = members(faces, part)
    upright = patches.normals(patch, vertices[vertex])
    inverse = np.linalg.inv(_squares(vertex, upright, len(vertices)) + EIGENVALUE_FLOOR * np.eye(3))
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
    for _ in range(PATCH_FITS):
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
