# SPDX-License-Identifier: MIT
"""Faults of a surface, one line each; such a surface can still be simulated."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components

from sononerf.array_types import Bools, Floats, Ints
from sononerf.geometry.raycast import winding_numbers

FLAT = 1e-7
"""Height of a triangle over its longest side below which it has no area in single precision."""
TWICE = 1e-6
"""Distance of two vertices, over the size of the surface, below which they are the same place."""
MOST_BODIES = 2000
"""Number of bodies, the largest first, that are searched for others inside them."""
MOST_POINTS = 1000
"""Number of vertices of a body that are tested; a body is inside another if all of them are."""
THIN = 1e-9
"""Volume of a body over the cube of its length below which it has no inside."""


def surface_faults(vertices: ArrayLike, faces: ArrayLike) -> list[str]:
    """Return the faults of a surface.

    Args:
        vertices ((V, 3), m): Finite.
        faces (T, 3): Triangles, at least one.

    Returns:
        lines: Triangles without area, open and oddly shared edges, triangles that disagree on which
            side is outside, bodies that are inside out or wholly inside another; none where all is
            well.
    """
    corners, triangles = np.asarray(vertices, dtype=np.float64), np.asarray(faces)
    lines = []
    flat = int(_is_flat(corners, triangles).sum())
    if flat:
        lines.append(
            f"the mesh has {_count(flat, 'triangle')} without area; nothing is heard there"
        )
    triangles = _with_three_corners(triangles)
    edges = _edges(triangles, len(corners))
    if edges.open.any():
        lines.append(_openness(corners, triangles, edges))
    elif edges.crowded.any():
        crowded = _count(int(edges.crowded.sum()), "edge")
        lines.append(
            f"the mesh is open ({crowded} shared by more than two triangles); volumes will not be "
            "measured"
        )
    if edges.against.any():
        lines.append(
            "the mesh's triangles do not agree on which side is outside "
            f"({_count(int(edges.against.sum()), 'edge')} between triangles that face two ways)"
        )
    return [*lines, *_oddities(corners, triangles, _bodies(corners, triangles, edges))]


@dataclass(frozen=True)
class _Edges:
    """Edges of a surface, each once: its ends and its faults."""

    ends: Ints  # (K, 2)
    open: Bools
    crowded: Bools
    against: Bools


def _count(number: int, what: str) -> str:
    return f"{number} {what}{'' if number == 1 else 's'}"


def _is_flat(corners: Floats, triangles: Ints) -> Bools:
    a, b, c = (corners[triangles[:, k]] for k in range(3))
    sides = np.stack([b - a, c - b, a - c])
    longest = np.einsum("ktd,ktd->kt", sides, sides).max(axis=0)
    area = np.cross(sides[0], sides[1])
    flat: Bools = np.einsum("td,td->t", area, area) <= (FLAT * longest) ** 2
    return flat


def _with_three_corners(triangles: Ints) -> Ints:
    a, b, c = triangles.T
    return triangles[(a != b) & (b != c) & (c != a)]


def _edges(triangles: Ints, count: int) -> _Edges:
    start = triangles.T.ravel().astype(np.int64)
    end = np.roll(triangles, -1, axis=1).T.ravel().astype(np.int64)
    key = np.minimum(start, end) * count + np.maximum(start, end)
    # The lowest bit says which way round the edge is used.
    key = np.sort(2 * key + (start < end))
    new = np.flatnonzero(np.diff(key >> 1, prepend=-1))
    uses = np.diff(new, append=len(key))
    forward = np.add.reduceat(key & 1, new) if len(new) else new
    ends = np.stack(np.divmod(key[new] >> 1, count), axis=1)
    return _Edges(ends, uses % 2 == 1, uses > 2, (uses % 2 == 0) & (2 * forward != uses))


def _named(indices: Ints, count: int) -> Ints:
    there = np.zeros(count, dtype=bool)
    there[indices] = True
    return np.flatnonzero(there)


def _openness(corners: Floats, triangles: Ints, edges: _Edges) -> str:
    """Say that a surface is open, and whether vertices that stand twice are all there is to it."""
    number = int(edges.open.sum())
    rim = _named(edges.ends[edges.open], len(corners))
    size = float(np.ptp(corners[_named(triangles, len(corners))], axis=0).max())
    places = np.round((corners[rim] - corners[rim].min(axis=0)) / (TWICE * size)).astype(np.int64)
    x, y, z = places.T
    _, first, same = np.unique(
        ((x << 21) + y << 21) + z,
        return_index=True,
        return_inverse=True,  # each is below 2**20
    )
    merged = np.arange(len(corners))
    merged[rim] = rim[first[same]]
    left = int(_edges(_with_three_corners(merged[triangles]), len(corners)).open.sum())
    said = f"the mesh is open ({_count(number, 'edge')} of one triangle alone"
    if left < number:
        rest = f"leave {left} of them" if left else "close it"
        twice = len(rim) - len(first)
        said += f"; {twice} of their {len(rim)} vertices stand twice, merging would {rest}"
    return f"{said}); volumes will not be measured"


@dataclass(frozen=True)
class _Bodies:
    """Connected parts of a surface; which of them enclose a volume, and how much."""

    of_corner: Ints  # (V,) number of the body
    of_triangle: Ints  # (T,)
    low: Floats  # (K, 3)
    high: Floats  # (K, 3)
    volume: Floats  # (K,), negative where inside out
    closed: Ints  # numbers of those that enclose a volume, largest first


def _bodies(corners: Floats, triangles: Ints, edges: _Edges) -> _Bodies:
    shape = (len(corners), len(corners))
    links = coo_array((np.ones(len(edges.ends), dtype=bool), edges.ends.T), shape=shape)
    count, of_corner = connected_components(links, directed=False)
    of_triangle = of_corner[triangles[:, 0]]
    order, starts = _members(of_corner, count)
    low = np.minimum.reduceat(corners[order], starts[:-1])
    high = np.maximum.reduceat(corners[order], starts[:-1])
    a, b, c = (corners[triangles[:, k]] - corners.mean(axis=0) for k in range(3))
    sixth = np.einsum("td,td->t", a, np.cross(b, c)) / 6.0
    volume = np.asarray(np.bincount(of_triangle, sixth, count), dtype=np.float64)
    closed = np.abs(volume) > THIN * (high - low).max(axis=1) ** 3
    closed[of_corner[edges.ends[edges.open | edges.against, 0]]] = False
    largest_first = np.argsort(-np.abs(volume), kind="stable")
    return _Bodies(of_corner, of_triangle, low, high, volume, largest_first[closed[largest_first]])


def _members(of: Ints, count: int) -> tuple[Ints, Ints]:
    """Return indices sorted by the body they are of, and where each body starts, (K + 1,)."""
    order = np.argsort(of, kind="stable")
    return order, np.searchsorted(of[order], np.arange(count + 1))


def _holders(corners: Floats, triangles: Ints, bodies: _Bodies) -> Ints:
    """Return for each body the number of one that it lies wholly inside of, or -1."""
    holder = np.full(len(bodies.volume), -1)
    closed, count = bodies.closed, len(bodies.volume)
    if len(closed) < 2:
        return holder
    order, starts = _members(bodies.of_corner, count)
    faces, first = _members(bodies.of_triangle, count)
    for outer in closed[:MOST_BODIES]:
        boxed = (bodies.low[closed] > bodies.low[outer]) & (
            bodies.high[closed] < bodies.high[outer]
        )
        within = closed[boxed.all(axis=1)]
        members = [order[starts[inner] : starts[inner + 1]] for inner in within]
        tried = [some[:: -(-len(some) // MOST_POINTS)] for some in members]
        if len(within):
            own = triangles[faces[first[outer] : first[outer + 1]]]
            windings = winding_numbers(corners, own, corners[np.concatenate(tried)])
            begins = np.cumsum([0, *(len(some) for some in tried[:-1])])
            holder[within[np.minimum.reduceat(np.abs(windings), begins) > 0.5]] = outer
    return holder


def _oddities(corners: Floats, triangles: Ints, bodies: _Bodies) -> list[str]:
    holder, volume, count = _holders(corners, triangles, bodies), bodies.volume, len(bodies.closed)
    # A body that faces the other way than the one around it is that one's hollow.
    hollow = (holder >= 0) & (volume * volume[holder] < 0.0)
    inverted = int(((volume < 0.0) & ~hollow)[bodies.closed].sum())
    inside = int((holder >= 0).sum())
    lines = []
    if inverted:
        verb = "is" if inverted == 1 else "are"
        which = "the mesh is" if count == 1 else f"{inverted} of the mesh's {count} bodies {verb}"
        lines.append(f"{which} inside out; echoes do not mind, volumes do")
    if inside:
        verb = "lies" if inside == 1 else "lie"
        lines.append(
            f"{inside} of the mesh's {count} bodies {verb} wholly inside another; from outside "
            "nothing is heard there"
        )
    return lines
