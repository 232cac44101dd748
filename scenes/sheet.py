# SPDX-License-Identifier: MIT
"""Thin sheets: an outline filled with even triangles, given two sides and a rim."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import trimesh
from numpy.typing import NDArray
from scipy.spatial import Delaunay, cKDTree

from .loft import evenly

ALONG_RIM = 0.9
"""Distance of the rim's points, and..."""
FROM_RIM = 0.65
"""...how far the inner ones stay away from them, in spacings: no edge of the rim is lost then."""


@dataclass(frozen=True, eq=False)
class Outline:
    """What lies between two curves over x.

    Attributes:
        x ((K,), m): Ascending.
        low, high ((K,), m): The curves; they may meet at the ends, and nowhere else.
    """

    x: NDArray[np.float64]
    low: NDArray[np.float64]
    high: NDArray[np.float64]

    def contains(self, points: NDArray[np.float64], margin: float = 0.0) -> NDArray[np.bool_]:
        """Whether points (N, 2) lie inside, at least a margin (m) from the ends and curves."""
        x, y = points.T
        low, high = np.interp(x, self.x, self.low), np.interp(x, self.x, self.high)
        within = (x > self.x[0] + margin) & (x < self.x[-1] - margin)
        inside: NDArray[np.bool_] = within & (y > low + margin) & (y < high - margin)
        return inside

    def rim(self, step: float) -> NDArray[np.float64]:
        """Return points (N, 2) all round, counter-clockwise, a step (m) apart at most."""
        low, high = np.stack([self.x, self.low], 1), np.stack([self.x, self.high], 1)
        sides = [low, np.stack([low[-1], high[-1]]), high[::-1], np.stack([high[0], low[0]])]
        pieces = [_resampled(side, step)[:-1] for side in sides]
        return np.concatenate(pieces)


def _resampled(line: NDArray[np.float64], step: float) -> NDArray[np.float64]:
    """Return points along a line, evenly, its ends among them; one where it has no length."""
    length = np.concatenate(([0.0], np.cumsum(np.linalg.norm(np.diff(line, axis=0), axis=1))))
    if length[-1] == 0.0:
        return line[:1]
    at = evenly(np.array([[0.0, 0.0, 0.0], [length[-1], 0.0, 0.0]]), step)[:, 0]
    return np.stack([np.interp(at, length, line[:, axis]) for axis in range(2)], axis=1)


def filled(outline: Outline, spacing: float) -> tuple[NDArray[np.float64], NDArray[np.int64]]:
    """Fill an outline with triangles that are nearly equilateral.

    Args:
        outline: The shape.
        spacing (m): Spacing of a hexagonal lattice, one of whose rows is y = 0; edges near the rim
            are up to 1.7 times as long.

    Returns:
        points ((N, 2), m): On the rim and inside.
        triangles (T, 3): Counter-clockwise.
    """
    rim = outline.rim(ALONG_RIM * spacing)
    low, high = rim.min(axis=0), rim.max(axis=0)
    rise = spacing * np.sqrt(0.75)
    rows = np.arange(np.floor(low[1] / rise), np.ceil(high[1] / rise) + 1)
    columns = np.arange(np.floor(low[0] / spacing) - 1, np.ceil(high[0] / spacing) + 1)
    row, column = np.meshgrid(rows, columns, indexing="ij")
    lattice = np.stack([(column + 0.5 * (row % 2)) * spacing, row * rise], axis=-1).reshape(-1, 2)
    lattice = lattice[outline.contains(lattice)]
    distance, _ = cKDTree(rim).query(lattice)
    points = np.concatenate([rim, lattice[distance > FROM_RIM * spacing]])
    triangles = Delaunay(points).simplices.astype(np.int64)
    corners = points[triangles]
    a, b = corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]
    area = a[:, 0] * b[:, 1] - a[:, 1] * b[:, 0]
    triangles[area < 0.0] = triangles[area < 0.0][:, ::-1]
    longest = np.linalg.norm(corners - np.roll(corners, 1, axis=1), axis=2).max(axis=1)
    # Of the points' convex hull, what lies beyond hollow sides; slivers along straight ones.
    kept = outline.contains(corners.mean(axis=1)) & (longest < 2.0 * spacing)
    kept &= np.abs(area) > 1e-6 * spacing**2
    return points, triangles[kept]


def two_sided(
    top: NDArray[np.float64], bottom: NDArray[np.float64], triangles: NDArray[np.int64]
) -> trimesh.Trimesh:
    """Build a closed sheet of two sides and the rim between them.

    Args:
        top, bottom ((N, 3), m): Places of the points of a filled outline on either side; the top is
            the side from which its triangles run counter-clockwise.
        triangles (T, 3): Triangles of the outline.

    Returns:
        sheet: Vertices of the top first, then the bottom's.
    """
    count = len(top)
    start = triangles.ravel()
    end = np.roll(triangles, -1, axis=1).ravel()
    # Edges within the outline are used once each way; those of the rim only as they run.
    alone = ~np.isin(start * count + end, end * count + start)
    start, end = start[alone], end[alone]
    rim = [(end, start, start + count), (end, start + count, end + count)]
    walls = [np.stack(corners, axis=1) for corners in rim]
    faces = np.concatenate([triangles, triangles[:, ::-1] + count, *walls])
    return trimesh.Trimesh(np.concatenate([top, bottom]), faces, process=False)
