# SPDX-License-Identifier: MIT
"""A cubic lattice: values of points spread onto it, and read off it; surfaces of one value."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import trimesh
from numpy.typing import ArrayLike, NDArray
from scipy.ndimage import gaussian_filter, map_coordinates
from skimage.measure import marching_cubes

from sononerf.array_types import Floats, Singles

MARGIN = 3
"""Number of empty voxels around the box: they close a surface at its border."""


@dataclass(frozen=True, eq=False)
class Lattice:
    """Places of voxels.

    Attributes:
        origin ((3,), m): Centre of the first voxel.
        spacing (m): Between centres.
        shape: Voxels along x, y and z.
    """

    origin: Floats
    spacing: float
    shape: tuple[int, int, int]

    @classmethod
    def over(cls, lower: Floats, upper: Floats, spacing: float) -> Lattice:
        """Return a lattice over a box and a margin around it."""
        x, y, z = (int(np.ceil(n - 1e-9)) + 1 + 2 * MARGIN for n in (upper - lower) / spacing)
        return cls(np.asarray(lower, dtype=np.float64) - MARGIN * spacing, spacing, (x, y, z))

    def coordinates(self, points: Floats) -> Floats:
        """Return where points lie, in voxels from the first."""
        return (points - self.origin) / self.spacing

    def points(self) -> Floats:
        """Return the centres of all voxels, (N, 3) m."""
        return self.origin + self.spacing * np.argwhere(np.ones(self.shape, dtype=bool))

    def spread(self, points: Floats, values: Floats, deviation: float = 0.0) -> Singles:
        """Add values (N,) of points to the voxels around them, and blur by a number of voxels."""
        place = self.coordinates(points)
        base = np.floor(place).astype(np.intp)
        fraction = place - base
        within = ((base >= 0) & (base < np.asarray(self.shape) - 1)).all(axis=1)
        base, fraction, values = base[within], fraction[within], values[within]
        total = np.zeros(int(np.prod(self.shape)))
        for corner in np.ndindex(2, 2, 2):
            part = np.prod(np.where(corner, fraction, 1 - fraction), axis=1)
            flat = np.ravel_multi_index(tuple((base + np.asarray(corner)).T), self.shape)
            total += np.bincount(flat, values * part, total.size)
        grid = total.reshape(self.shape).astype(np.float32)
        if deviation:
            grid = gaussian_filter(grid, deviation, mode="constant")
        return np.asarray(grid, dtype=np.float32)

    def read(self, grid: NDArray[np.floating], points: Floats) -> Floats:
        """Read a grid at points, linearly between voxels, (N,)."""
        read: Floats = map_coordinates(
            grid, self.coordinates(points).T, order=1, mode="nearest", output=np.float64
        )
        return read


def level_surface(
    grid: NDArray[np.floating], level: float, origin: ArrayLike = 0.0, spacing: float = 1.0
) -> trimesh.Trimesh:
    """Return the surface on which a grid takes a level, by marching cubes.

    In: grid (X, Y, Z), origin ((3,), m), spacing (m).
    """
    vertices, faces, _, _ = marching_cubes(
        grid.astype(np.float32), level, gradient_direction="ascent", allow_degenerate=False
    )
    places = np.asarray(origin) + spacing * np.asarray(vertices, dtype=np.float64)
    mesh = trimesh.Trimesh(places, faces, process=False, validate=False)
    if signed_volume(mesh) < 0:
        mesh.invert()
    return mesh


def signed_volume(mesh: trimesh.Trimesh) -> float:
    """Return the volume of a closed mesh, m³, negative if it is inside out; it may be zero."""
    corners = np.asarray(mesh.vertices)[np.asarray(mesh.faces)]
    return float(np.linalg.det(corners - corners.mean(axis=(0, 1))).sum() / 6.0)
