# SPDX-License-Identifier: MIT
"""Regular grids of voxels (metres, world frame), and their iso-surfaces."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
import trimesh
from numpy.typing import ArrayLike, NDArray
from scipy.ndimage import map_coordinates
from skimage.filters import threshold_otsu
from skimage.measure import marching_cubes

from sononerf.errors import NumericalError
from sononerf.numerics import Floats
from sononerf.resources import require_memory

MARGIN = 3
"""Number of empty voxels around the box: they close a surface at its border."""


@dataclass(frozen=True, eq=False)
class Lattice:
    """Places of voxels."""

    origin: Floats  # (3,), m: Centre of the first voxel
    spacing: float  # m: Between centres
    shape: tuple[int, int, int]  # Voxels along x, y and z

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

    def read(self, grid: NDArray[np.floating], points: Floats) -> Floats:
        """Read a grid at points, linearly between voxels, (N,)."""
        return map_coordinates(
            grid, self.coordinates(points).T, order=1, mode="nearest", output=np.float64
        )


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


BYTES_PER_VOXEL = 80
"""Memory of a value and of the copies that an iso-surface takes, bytes, measured."""


@dataclass(frozen=True, eq=False)
class Volume:
    """Values on a regular grid. In: values (X, Y, Z), origin ((3,), m), spacing (m)."""

    values: NDArray[np.floating]
    origin: Floats
    spacing: float

    @property
    def shape(self) -> tuple[int, int, int]:
        """Number of voxels along x, y and z."""
        x, y, z = self.values.shape
        return x, y, z

    @property
    def upper(self) -> Floats:
        """Centre of the last voxel, (3,) m."""
        return self.origin + self.spacing * (np.asarray(self.shape) - 1)

    def axes(self) -> tuple[Floats, Floats, Floats]:
        """Return the voxels' centres along each axis: (X,), (Y,), (Z,) m."""
        x, y, z = (
            start + self.spacing * np.arange(count)
            for start, count in zip(self.origin, self.shape, strict=True)
        )
        return x, y, z

    def points(self) -> Floats:
        """Return the voxels' centres, (X*Y*Z, 3) m, in the order of ``values.ravel()``."""
        return _centres(self.axes(), 0, self.values.size)

    def with_values(self, values: NDArray[np.floating]) -> Volume:
        """Return a volume on the same grid with other values, (X, Y, Z)."""
        return Volume(values, self.origin, self.spacing)


def _centres(axes: tuple[Floats, ...], start: int, stop: int) -> Floats:
    shape = tuple(len(axis) for axis in axes)
    indices = np.unravel_index(np.arange(start, stop), shape)
    return np.stack([axis[index] for axis, index in zip(axes, indices, strict=True)], axis=1)


def grid_over(lower: ArrayLike, upper: ArrayLike, spacing: float) -> Volume:
    """Return a volume of zeros whose voxel centres cover a box, centred on it.

    In: lower, upper ((3,), m), spacing (m).
    """
    low, high = np.asarray(lower, dtype=np.float64), np.asarray(upper, dtype=np.float64)
    # The small number keeps 0.3 / 0.1 from asking for a fourth interval.
    x, y, z = (int(np.ceil(n - 1e-9)) + 1 for n in (high - low) / spacing)
    require_memory(
        float(x) * y * z * BYTES_PER_VOXEL,
        f"a grid of {x} by {y} by {z} voxels",
        f"choose a spacing above {spacing:.3g} m",
    )
    origin = (low + high) / 2 - spacing * (np.array([x, y, z]) - 1) / 2
    return Volume(np.zeros((x, y, z)), origin, float(spacing))


def volume_from_function(
    function: Callable[[Floats], ArrayLike],
    lower: ArrayLike,
    upper: ArrayLike,
    spacing: float,
    *,
    chunk: int = 65_536,
    progress: Callable[[int, int], None] | None = None,
) -> Volume:
    """Evaluate a function at every voxel, so many at a time that memory stays bounded.

    A position does not depend on the chunk that it falls into, so that a function of the position
    alone gives the same volume whatever ``chunk`` is.

    In: lower, upper ((3,), m), spacing (m).
    """
    volume = grid_over(lower, upper, spacing)
    axes, flat, total = volume.axes(), volume.values.reshape(-1), volume.values.size
    for start in range(0, total, chunk):
        stop = min(start + chunk, total)
        points = _centres(axes, start, stop)
        values = np.asarray(function(points), dtype=np.float64)
        if not np.isfinite(values).all():
            where = points[np.flatnonzero(~np.isfinite(values))[0]]
            raise NumericalError(
                f"the field is not finite at {np.round(where, 4).tolist()} m; the fit has diverged"
            )
        flat[start:stop] = values
        if progress is not None:
            progress(stop, total)
    return volume


def require_finite(volume: Volume) -> None:
    """Refuse a volume that holds NaN or infinity."""
    faulty = volume.values.size - int(np.isfinite(volume.values).sum())
    if faulty:
        raise NumericalError(
            f"{faulty} of {volume.values.size} voxels are not finite; the fit has diverged"
        )


def vti_bytes(volume: Volume, name: str = "reflectivity") -> bytes:
    """Return a VTK image file (``.vti``) that ParaView and 3D Slicer open, in metres."""
    import pyvista
    from vtkmodules.vtkIOXML import vtkXMLImageDataWriter

    image = pyvista.ImageData(
        dimensions=volume.shape, spacing=(volume.spacing,) * 3, origin=volume.origin
    )
    image.point_data[name] = np.asarray(volume.values, np.float32).ravel(order="F")
    writer = vtkXMLImageDataWriter()
    writer.SetInputData(image)
    writer.SetDataModeToBinary()
    writer.WriteToOutputStringOn()
    writer.Write()
    return str(writer.GetOutputString()).encode("ascii")


# How near to a voxel's centre the surface may pass, in voxels.
NEAREST = 1e-3


def isosurface(volume: Volume, level: float) -> trimesh.Trimesh:
    """Extract the closed surface around all that exceeds a level.

    Beyond the grid there is nothing: a body that reaches the grid's border is closed there.
    """
    require_finite(volume)
    values = np.asarray(volume.values, dtype=np.float64)
    low, high = float(values.min()), float(values.max())
    if not low < level < high:
        raise NumericalError(
            f"no surface at level {level:.6g}: the volume's values run from {low:.6g} to {high:.6g}"
        )
    # marching_cubes computes in float32: bring the values to 0 to 1 while they are float64.
    scaled = np.pad((values - low) / (high - low), 1)
    threshold = np.float32((level - low) / (high - low))
    tiny = np.finfo(np.float32).tiny
    threshold = np.clip(threshold, tiny, np.nextafter(np.float32(1), np.float32(0)))
    scaled = _kept_off(scaled, float(threshold)).astype(np.float32)
    if (scaled == threshold).any():
        # A voxel exactly on the level gives triangles without area; one ulp is no difference.
        threshold = np.nextafter(threshold, np.float32(1 if threshold < 0.5 else 0))
    origin = volume.origin - volume.spacing  # of the padded grid
    return level_surface(scaled, float(threshold), origin, volume.spacing)


def _kept_off(values: Floats, level: float) -> Floats:
    """Move values off the level, as far as moves the surface by a thousandth of a voxel.

    A voxel on the level, or all but, is wrapped in triangles too small to have a normal.
    """
    steepest = np.zeros_like(values)
    for axis in range(3):
        steps = np.abs(np.diff(values, axis=axis))
        first, last = [slice(None)] * 3, [slice(None)] * 3
        first[axis], last[axis] = slice(None, -1), slice(1, None)
        for side in (tuple(first), tuple(last)):
            np.maximum(steepest[side], steps, out=steepest[side])
    gap = NEAREST * steepest
    above = values - level
    return np.where(np.abs(above) < gap, level + np.where(above < 0, -gap, gap), values)


def automatic_level(volume: Volume) -> float:
    """Choose the level of a surface from the values alone.

    Otsu's threshold on the values: the level that parts them into two heaps, air and surface, each
    as even in itself as can be. The choice scales with the values. On blurred, uneven shells it
    comes within 0.04 of the F-score at 5 mm of the best of twelve levels; thresholds on decibels or
    at the steepest gradient, tried in its place, swell or shatter the body.

    References:
        .. [1] N. Otsu, "A threshold selection method from gray-level histograms", 1979.
    """
    require_finite(volume)
    values = np.asarray(volume.values, dtype=np.float64)
    low, high = float(values.min()), float(values.max())
    if low == high:
        raise NumericalError(f"no level separates the volume's values: all are {low:.6g}")
    scaled = (values.ravel() - low) / (high - low)
    return low + (high - low) * float(threshold_otsu(scaled, nbins=1024))
