# SPDX-License-Identifier: MIT
"""Flat parts of a surface, found by hierarchical clustering of its triangles [1]_.

References:
    .. [1] M. Garland, A. Willmott and P. S. Heckbert, "Hierarchical face clustering on polygonal
       surfaces", I3D 2001.
"""

from __future__ import annotations

import heapq
import math

import numpy as np
import trimesh

from sononerf.numerics import Floats, Ints, compiled

COHERENT = 0.9
"""Least length of the mean of a part's unit normals, no unit. The two sides of a thin plate have a
mean of zero, so they stay apart."""
SMOOTHING = 0.3
"""What a triangle gains by each neighbour of the same part, no unit; its cost is the square of its
distance from the plane over the tolerance."""
UPRIGHT = 0.5
"""Further cost of a triangle whose normal is square to that of the plane, no unit."""
SWEEPS = 15
"""Number of times that triangles are given to the plane that fits them best, at most."""


def flat_parts(mesh: trimesh.Trimesh, tolerance: float, least: float) -> Ints:
    """Return the number of the flat part (T,) that each triangle belongs to.

    In: tolerance (m), least (m²).
    """
    corners = np.asarray(mesh.triangles, dtype=np.float64)
    pairs = np.asarray(mesh.face_adjacency, dtype=np.int64)
    part = _clustered(*_moments(corners), pairs, tolerance**2, COHERENT)
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
        for sweep in range(SWEEPS):
            choice = np.concatenate([part[:, None], part[beside]], axis=1)
            off = np.einsum("td,tcd->tc", middle, normal[choice]) - offset[choice]
            tilt = 1.0 - np.einsum("td,tcd->tc", upright, normal[choice])
            like = (choice[:, :, None] == part[beside][:, None]).sum(axis=2)
            cost = np.square(off / tolerance) + UPRIGHT * tilt - SMOOTHING * like
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
