# SPDX-License-Identifier: MIT
"""Where parallel lines cross a mesh: a layered depth map, exact and without a ray caster."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any

import numpy as np
import trimesh
from numpy.typing import NDArray

from sononerf.evaluation.solid import Solid

# Pairs of triangle and line that are tested at once; bounds the memory to some 100 MB.
CHUNK_PAIRS = 1_000_000


@dataclass(frozen=True, eq=False)
class Crossings:
    """Where lines along the first axis cross triangles, in no particular order.

    Parameters
    ----------
    line : (N,) int
        Index of the line, ``row * columns + column``.
    depth : (N,) float
        First coordinate of the crossing.
    face : (N,) int
        Index of the triangle.
    second, third : (N,) float
        Barycentric weights of the triangle's second and third corner.
    entering : (N,) bool
        Whether a line that runs towards greater depth enters the body there.
    """

    line: NDArray[np.intp]
    depth: NDArray[np.float64]
    face: NDArray[np.intp]
    second: NDArray[np.float64]
    third: NDArray[np.float64]
    entering: NDArray[np.bool_]


def _edge(
    plane: NDArray[np.float64],
    start: NDArray[np.intp],
    end: NDArray[np.intp],
    point: NDArray[np.float64],
) -> NDArray[np.float64]:
    """Twice the signed area of (start, end, point); exactly opposite for the opposite edge."""
    # Both triangles at an edge must compute the same number, or lines slip through the seam.
    low, high = np.minimum(start, end), np.maximum(start, end)
    a, b = plane[low], plane[high]
    along = b - a
    away = point - a
    area = along[:, 0] * away[:, 1] - along[:, 1] * away[:, 0]
    # A point on the edge counts as moved by (ε, ε²), so that it lies in one triangle of all that
    # meet there.
    side = np.where(along[:, 1] != 0, -along[:, 1], along[:, 0])
    area = np.where(area == 0, np.sign(side) * np.finfo(np.float64).tiny, area)
    result: NDArray[np.float64] = np.where(start < end, area, -area)
    return result


def _candidates(
    first: NDArray[np.intp], last: NDArray[np.intp]
) -> Iterator[tuple[NDArray[np.intp], NDArray[np.intp], NDArray[np.intp]]]:
    """Yield (face, row, column) for every line inside each triangle's bounding rectangle."""
    counts = np.maximum(last - first + 1, 0)  # (T, 2)
    pairs = counts.prod(axis=1)
    faces = np.flatnonzero(pairs)
    cumulative = np.cumsum(pairs[faces])
    start = 0
    while start < len(faces):
        before = cumulative[start - 1] if start else 0
        stop = max(start + 1, int(np.searchsorted(cumulative, before + CHUNK_PAIRS, "right")))
        chunk = faces[start:stop]
        face = np.repeat(chunk, pairs[chunk])
        offset = np.cumsum(pairs[chunk]) - pairs[chunk]
        within = np.arange(len(face)) - np.repeat(offset, pairs[chunk])
        row = first[face, 0] + within // counts[face, 1]
        column = first[face, 1] + within % counts[face, 1]
        yield face, row, column
        start = stop


def crossings(
    vertices: NDArray[np.float64],
    faces: NDArray[np.integer],
    rows: NDArray[np.float64],
    columns: NDArray[np.float64],
) -> Crossings:
    """Find where lines along the first axis cross a mesh.

    Parameters
    ----------
    vertices : (V, 3) float
        Depth, and the two coordinates of the plane of the lines.
    faces : (T, 3) int
        Corners, anticlockwise seen from outside.
    rows, columns : (rows,), (columns,) float
        Evenly spaced, ascending positions of the lines along the second and the third axis.

    Returns
    -------
    crossings : Crossings
        A closed mesh is left as often as it is entered by every line.
    """
    plane = np.ascontiguousarray(vertices[:, 1:])
    corners = np.asarray(faces, dtype=np.intp)
    start = np.array([rows[0], columns[0]])
    step = np.array([axis[1] - axis[0] if len(axis) > 1 else 1.0 for axis in (rows, columns)])
    limit = np.array([len(rows), len(columns)]) - 1
    flat = (plane[corners] - start) / step  # (T, 3, 2)
    # Rounding must not part a triangle from a line along its edge.
    first = np.maximum(np.ceil(flat.min(axis=1) - 1e-9), 0).astype(np.intp)
    last = np.minimum(np.floor(flat.max(axis=1) + 1e-9), limit).astype(np.intp)
    found: list[tuple[NDArray[Any], ...]] = []
    for face, row, column in _candidates(first, last):
        point = np.stack([rows[row], columns[column]], axis=1)
        a, b, c = corners[face].T
        weights = np.stack(
            [_edge(plane, b, c, point), _edge(plane, c, a, point), _edge(plane, a, b, point)]
        )
        hit = (weights > 0).all(axis=0) | (weights < 0).all(axis=0)
        weights, face = weights[:, hit], face[hit]
        area = weights.sum(axis=0)
        weights = weights / area
        depth = (weights * vertices[corners[face], 0].T).sum(axis=0)
        line = row[hit] * len(columns) + column[hit]
        # Anticlockwise in (second, third) means a normal towards greater depth: the line leaves.
        found.append((line, depth, face, weights[1], weights[2], area < 0))
    if not found:
        none, index = np.zeros(0), np.zeros(0, np.intp)
        return Crossings(index, none, index, none, none, np.zeros(0, bool))
    return Crossings(*(np.concatenate(part) for part in zip(*found, strict=True)))


def inside_intervals(
    found: Crossings,
) -> tuple[NDArray[np.intp], NDArray[np.float64], NDArray[np.float64]]:
    """Return the stretches of the lines inside the union of all bodies.

    A point is inside where the line has entered more bodies than it has left, so that bodies that
    overlap count once and a cavity, whose surface faces inward, does not count.

    Returns
    -------
    line : (N,) int
        Index of the line.
    start, stop : (N,) float
        Depths between which the line is inside.
    """
    order = np.lexsort((found.depth, found.line))
    line, depth = found.line[order], found.depth[order]
    # A closed body adds as much as it takes on each line: the sum starts each line at zero.
    level = np.cumsum(np.where(found.entering[order], 1, -1))
    before = np.concatenate([[0], level[:-1]]) if len(level) else level
    opens, closes = (before <= 0) & (level > 0), (before > 0) & (level <= 0)
    return line[opens], depth[opens], depth[closes]


# Lines across the bounding box on each axis: true to 1e-4 of a ball's volume.
LINES = 401

Stretches = tuple[NDArray[np.intp], NDArray[np.float64], NDArray[np.float64]]


def volumes(first: Solid, second: Solid) -> tuple[float, float, float]:
    """Return the volumes of two unions and of what they share, in m³.

    Exact lengths along 401 x 401 parallel lines across the bounding box.
    """
    both = [trimesh.util.concatenate(solid.bodies) for solid in (first, second)]
    low = np.min([mesh.bounds[0] for mesh in both], axis=0)
    high = np.max([mesh.bounds[1] for mesh in both], axis=0)
    step = (high - low)[1:] / LINES
    rows, columns = (low[axis] + step[axis - 1] * (np.arange(LINES) + 0.5) for axis in (1, 2))
    stretches = [
        inside_intervals(
            crossings(np.asarray(mesh.vertices), np.asarray(mesh.faces), rows, columns)
        )
        for mesh in both
    ]
    cell = float(step[0] * step[1])
    one, two = (cell * float((stop - start).sum()) for _, start, stop in stretches)
    return one, two, cell * _shared_length(*stretches)


def _shared_length(first: Stretches, second: Stretches) -> float:
    """Return the total length that lies in a stretch of both."""
    line = np.concatenate([first[0], first[0], second[0], second[0]])
    depth = np.concatenate([first[1], first[2], second[1], second[2]])
    change = np.concatenate(
        [sign * np.ones(len(part[0])) for part in (first, second) for sign in (1, -1)]
    )
    order = np.lexsort((depth, line))
    level = np.cumsum(change[order])[:-1]
    gaps = np.diff(depth[order])
    # Stretches of one solid never overlap, so a level of two means that both are there.
    return float(gaps[level > 1.5].sum())
