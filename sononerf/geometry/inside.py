# SPDX-License-Identifier: MIT
"""Whether places lie inside a surface, also where bodies overlap or a surface is open."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np
from numpy.typing import ArrayLike, NDArray

from sononerf.geometry.poses import rotation_from_euler

# No line of sight runs along these axes through an edge or a corner but by ill chance.
TURNED = rotation_from_euler(0.5, 0.7, 0.3)
PAIRS_AT_ONCE = 1_000_000


def winding_numbers(
    vertices: ArrayLike, faces: ArrayLike, points: ArrayLike
) -> NDArray[np.float64]:
    """Count how often a surface winds round points.

    Six lines of sight leave each point, along three axes square to one another. On each the
    triangles that are left behind count one, those that are entered minus one, and the mean is
    taken. Of closed bodies it is exact: one inside, two where two overlap, negative where they
    are inside out. Of an open surface it is the share of the directions that it fills, in sixths.

    Args:
        vertices ((V, 3), m): Of the surface.
        faces (T, 3): Its triangles, counter-clockwise from outside.
        points ((N, 3), m): The places.

    Returns:
        windings (N,): Above one half is inside.
    """
    corners = np.asarray(vertices, dtype=np.float64)
    triangles, places = np.asarray(faces), np.asarray(points, dtype=np.float64)
    total = np.zeros(len(places))
    low, high = corners[triangles].min(axis=(0, 1)), corners[triangles].max(axis=(0, 1))
    near = np.flatnonzero(((places >= low) & (places <= high)).all(axis=1))
    if len(near):
        corners, places = corners @ TURNED, places[near] @ TURNED
        for axes in ((0, 1, 2), (1, 2, 0), (2, 0, 1)):
            total[near] += _both_ways(corners[:, axes], triangles, places[:, axes]) / 6.0
    return total


def _both_ways(
    corners: NDArray[np.float64], triangles: NDArray[np.int64], places: NDArray[np.float64]
) -> NDArray[np.float64]:
    """Sum what is crossed up and down the third axis."""
    order = np.argsort(places[:, 0], kind="stable")
    sorted_places = places[order]
    total = np.zeros(len(places))
    for triangle, place in _near_pairs(corners, triangles, sorted_places):
        q = sorted_places[place]
        a, b, c = (corners[triangles[triangle, k]] for k in range(3))
        # Twice the areas of the triangles that the place makes with the sides, seen from above.
        of_c, of_a, of_b = (_area(q, a, b), _area(q, b, c), _area(q, c, a))
        up = (of_a > 0) & (of_b > 0) & (of_c > 0)
        down = (of_a < 0) & (of_b < 0) & (of_c < 0)
        hit = np.flatnonzero(up | down)
        weights = np.stack([of_a, of_b, of_c])[:, hit]
        heights = np.stack([a[hit, 2], b[hit, 2], c[hit, 2]])
        above = (weights * heights).sum(axis=0) / weights.sum(axis=0) > q[hit, 2]
        total += np.bincount(
            order[place[hit]], np.where(up[hit] == above, 1.0, -1.0), minlength=len(places)
        )
    return total


def _near_pairs(
    corners: NDArray[np.float64], triangles: NDArray[np.int64], places: NDArray[np.float64]
) -> Iterator[tuple[NDArray[np.int64], NDArray[np.int64]]]:
    """Yield triangles and places, sorted along the first axis, whose first two axes overlap."""
    along = corners[:, 0][triangles]
    first = np.searchsorted(places[:, 0], along.min(axis=1))
    count = np.searchsorted(places[:, 0], along.max(axis=1), side="right") - first
    chosen = np.flatnonzero(count)
    ends = np.cumsum(count[chosen])
    start = 0
    while start < len(chosen):
        before = ends[start - 1] if start else 0
        stop = max(start + 1, int(np.searchsorted(ends, before + PAIRS_AT_ONCE, side="right")))
        some = chosen[start:stop]
        triangle = np.repeat(some, count[some])
        within = np.arange(len(triangle)) - np.repeat(
            np.cumsum(count[some]) - count[some], count[some]
        )
        place = first[triangle] + within
        across = corners[:, 1][triangles[triangle]]
        y = places[place, 1]
        both = (across.min(axis=1) <= y) & (y <= across.max(axis=1))
        yield triangle[both], place[both]
        start = stop


def _area(
    q: NDArray[np.float64], a: NDArray[np.float64], b: NDArray[np.float64]
) -> NDArray[np.float64]:
    """Twice the signed area of triangles over the first two axes."""
    return (a[:, 0] - q[:, 0]) * (b[:, 1] - q[:, 1]) - (a[:, 1] - q[:, 1]) * (b[:, 0] - q[:, 0])
