# SPDX-License-Identifier: MIT
"""A closed surface from points that know how strong they are and which way they face.

An echo says where something reflects and which way it faces, blurred over some millimetres, twenty
decibels louder here than there. Thresholding that energy swells the loud places and loses the faint
ones. Here the points' normals are taken as the gradient of an indicator, one inside and zero
outside, which Poisson's equation gives back [1]_; the surface then runs where the points lie.

References
----------
.. [1] M. Kazhdan, M. Bolitho, H. Hoppe, "Poisson surface reconstruction", 2006, equation (4).
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

import numpy as np
import trimesh
from numpy.typing import ArrayLike, NDArray
from scipy import fft
from scipy.ndimage import gaussian_filter, map_coordinates
from scipy.spatial import cKDTree

from sononerf.errors import NumericalError
from sononerf.reconstruction.isosurface import isosurface
from sononerf.reconstruction.parts import supported_parts
from sononerf.reconstruction.volume import Volume, check_memory, grid_over

# Of the grid without air around it: 80 to 90 measured on a cube, twice that on a flat grid.
BYTES_PER_VOXEL = 200
# Air around the grid, as a share of its longest side: what the FFT's periodic images must cross.
PADDING = 0.15
# Standard deviations, in distances between neighbouring points, over which points support one
# another and over which the level adapts. Half and twice these change the Chamfer distance of
# blurred spheres by less than a tenth.
SUPPORT_RADIUS, LEVEL_RADIUS = 2.0, 4.0
# A place counts by this power of its energy: one would let the loud drown the faint, zero would
# lift the noise.
LOUDNESS_POWER = 0.5
# Neighbourhoods fainter than this share of the mean one fade out.
FAINT_SHARE = 0.03
# The share of a point's own energy that is not taken for support by its neighbours.
OWN_SHARE = 0.6
# Least local level, as a share of the mean one.
LEVEL_FLOOR = 0.05
# Least standard deviation of the smoothing, in distances between neighbouring points: with less
# the surface wraps single points.
MIN_SMOOTHING = 0.45


@dataclass(frozen=True, eq=False)
class _Cloud:
    """Points on a grid: coordinates (N, 3) in voxels, energies (N,), normals (N, 3)."""

    coordinates: NDArray[np.float64]
    energies: NDArray[np.float64]
    normals: NDArray[np.float64]
    shape: tuple[int, ...]
    pitch: float  # typical distance between neighbours, voxels

    def splat(self, weights: NDArray[np.float64]) -> NDArray[np.float32]:
        """Spread weights (N,) trilinearly over the voxels around the points."""
        base = np.floor(self.coordinates).astype(np.intp)
        fraction = self.coordinates - base
        total = np.zeros(int(np.prod(self.shape)))
        for corner in np.ndindex(2, 2, 2):
            share = np.prod(np.where(corner, fraction, 1 - fraction), axis=1)
            flat = np.ravel_multi_index(tuple((base + np.asarray(corner)).T), self.shape)
            total += np.bincount(flat, weights=weights * share, minlength=total.size)
        return total.reshape(self.shape).astype(np.float32)

    def read(self, values: NDArray[np.float32]) -> NDArray[np.float64]:
        """Read a grid trilinearly at the points, (N,)."""
        read: NDArray[np.float64] = map_coordinates(
            values, self.coordinates.T, order=1, output=np.float64
        )
        return read

    def blurred(self, weights: NDArray[np.float64], radius: float) -> NDArray[np.float32]:
        """Spread weights (N,) over a Gaussian of so many neighbour distances."""
        result: NDArray[np.float32] = gaussian_filter(
            self.splat(weights), radius * self.pitch, mode="constant", truncate=3
        )
        return result


def _cloud(
    points: NDArray[np.float64],
    energies: NDArray[np.float64],
    normals: NDArray[np.float64],
    grid: Volume,
) -> _Cloud:
    """Take the points that count, in voxels of the grid."""
    shape = tuple(count + 2 for count in grid.shape)
    coordinates = (points - grid.origin) / grid.spacing
    within = ((coordinates >= -1) & (coordinates < np.asarray(grid.shape))).all(axis=1)
    used = within & (energies > 0)
    if not used.any():
        raise NumericalError(
            f"no surface: none of {len(points)} points has energy and lies inside the region"
        )
    coordinates = coordinates[used]
    pitch = 1.0
    if len(coordinates) > 1:
        # A sample of the points tells their spacing as well as all do.
        some = coordinates[:: max(1, len(coordinates) // 5000)]
        pitch = max(1.0, float(np.median(cKDTree(coordinates).query(some, k=2)[0][:, 1])))
    # One voxel more on each side takes the shares of points at the border.
    return _Cloud(coordinates + 1, energies[used], normals[used], shape, pitch)


def _weights(cloud: _Cloud) -> NDArray[np.float64]:
    """Weigh the points so that faint places count and lone or contradicting points do not.

    What supports a point is the energy around it that faces its way. A point counts by its share of
    the place's energy, times a power of that energy, times how far others bear it out.
    """
    agreeing = np.zeros(len(cloud.energies))
    for axis in range(3):
        along = cloud.normals[:, axis]
        agreeing += along * cloud.read(cloud.blurred(cloud.energies * along, SUPPORT_RADIUS))
    own = cloud.energies / (np.sqrt(2 * np.pi) * SUPPORT_RADIUS * cloud.pitch) ** 3
    agreeing = np.maximum(agreeing, 0.3 * own)
    support = np.maximum(agreeing - OWN_SHARE * own, 0)
    mean = float(np.average(agreeing, weights=cloud.energies))
    relative = support / mean
    weights: NDArray[np.float64] = (
        cloud.energies
        / agreeing
        * (agreeing / mean) ** LOUDNESS_POWER
        * (support / agreeing) ** 2
        * relative**2
        / (relative**2 + FAINT_SHARE**2)
    )
    if not weights.sum() > 0:
        # Too few points to bear one another out: all that is known is their energy.
        return cloud.energies / cloud.energies.max()
    return weights


def _solve_poisson(
    cloud: _Cloud, weights: NDArray[np.float64], smoothing: float
) -> NDArray[np.float32]:
    """Solve ∇²χ = ∇·V for the inward vectors V, smoothed by a Gaussian, with χ = 0 far away."""
    air = 2 * max(8, round(PADDING * max(cloud.shape)))
    shape = tuple(int(fft.next_fast_len(count + air, real=True)) for count in cloud.shape)
    waves = []
    for axis, count in enumerate(shape):
        frequency = np.fft.rfftfreq(count) if axis == 2 else np.fft.fftfreq(count)
        ones = [1, 1, 1]
        ones[axis] = -1
        waves.append((2 * np.pi * frequency).astype(np.float32).reshape(ones))
    square = waves[0] ** 2 + waves[1] ** 2 + waves[2] ** 2
    square[0, 0, 0] = 1  # the mean is set below
    spectrum = np.zeros(square.shape, np.complex64)
    for axis, wave in enumerate(waves):
        spectrum += wave * fft.rfftn(cloud.splat(-weights * cloud.normals[:, axis]), s=shape)
    # ∇· is i k and ∇² is -k².
    spectrum *= -1j * np.exp(np.float32(-0.5 * smoothing**2) * square) / square
    chi: NDArray[np.float32] = fft.irfftn(spectrum, s=shape)
    # Halfway to the periodic images is as far away as it gets.
    middle = [
        chi.take((count + size) // 2, axis).mean()
        for axis, (count, size) in enumerate(zip(cloud.shape, shape, strict=True))
    ]
    x, y, z = cloud.shape
    return chi[:x, :y, :z] - np.float32(np.mean(middle))


def _levelled(
    cloud: _Cloud, weights: NDArray[np.float64], chi: NDArray[np.float32]
) -> NDArray[np.float32]:
    """Divide the indicator by twice its own value at the points nearby, so that they lie at 0.5.

    The indicator's height follows the weights, which differ from place to place; one level for all
    would swell the strong places and shrink the weak ones.
    """
    at_points = cloud.read(chi)
    mean = float(np.average(at_points, weights=weights))
    if not mean > 0:
        raise NumericalError(
            "no surface: what was heard encloses nothing, or its normals point inward; more calls "
            "or epochs may help"
        )
    density = cloud.blurred(weights, LEVEL_RADIUS)
    near = np.float32(0.01 * np.median(cloud.read(density)))
    local = cloud.blurred(weights * at_points, LEVEL_RADIUS)
    local += near * np.float32(mean)
    local /= density + near
    # Where the points contradict one another the local value may vanish.
    height = 2 * np.maximum(local, np.float32(LEVEL_FLOOR * mean))
    return np.divide(chi, height, dtype=np.float32)


def oriented_surface(
    points: ArrayLike,
    energies: ArrayLike,
    normals: ArrayLike,
    lower: ArrayLike,
    upper: ArrayLike,
    spacing: float,
    *,
    smoothing: float = 1.25,
    level: float | Literal["auto"] = "auto",
    bound: NDArray[np.float64] | None = None,
) -> tuple[trimesh.Trimesh, Volume, float]:
    """Read a closed surface out of points with energies and normals.

    Parameters
    ----------
    points : (N, 3) float, m
        World frame; those outside the box or without energy are not used.
    energies : (N,) float
        Zero or more; only ratios matter.
    normals : (N, 3) float
        Unit axes that point out of the body.
    lower, upper : (3,) float, m
        The box.
    spacing : float, m
        Voxel size; half the distance between neighbouring points is fine enough.
    smoothing : float, voxels
        Standard deviation of a Gaussian; raised where the points lie too far apart for it.
    level : float or "auto"
        Indicator on the surface. ``"auto"`` is its mean at the points themselves, about 0.5; a
        greater level gives a thinner body.
    bound : (X, Y, Z) float or None, m
        How deep inside of what is possible each voxel of :func:`grid_over` lies; the surface stays
        where this is zero or more.

    Returns
    -------
    mesh : Trimesh
        Closed, metres, world frame, normals outward; without hollows, parts below three voxels, and
        parts that have less than 1 % of a typical part's energy.
    indicator : Volume
        About one well inside, 0.5 at the points, and zero far outside.
    level : float
        The level used.

    Raises
    ------
    ValueError
        If shapes, box, spacing or smoothing are wrong, or an energy is negative.
    NumericalError
        If a number is not finite, no point has energy, or no surface is found.
    ResourceError
        If the grid would not fit in memory.
    """
    place, energy, normal = (np.asarray(a, dtype=np.float64) for a in (points, energies, normals))
    _check(place, energy, normal, smoothing)
    check_memory(lower, upper, spacing, bytes_per_voxel=BYTES_PER_VOXEL)
    grid = grid_over(lower, upper, spacing)
    cloud = _cloud(place, energy, normal, grid)
    weights = _weights(cloud)
    chi = _solve_poisson(cloud, weights, max(smoothing, MIN_SMOOTHING * cloud.pitch))
    chi = _levelled(cloud, weights, chi)
    used = float(np.average(cloud.read(chi), weights=weights)) if level == "auto" else float(level)
    values = chi[1:-1, 1:-1, 1:-1].astype(np.float64)
    if bound is not None:
        # As steep as the indicator itself where it runs through the points: what is steeper on one
        # side than on the other is drawn in the wrong place between voxels.
        slopes = np.gradient(chi)
        steep = cloud.read(np.sqrt(sum(slope**2 for slope in slopes), dtype=np.float32))
        slope = float(np.average(steep, weights=weights)) / spacing
        values = np.minimum(values, used + slope * bound)
    indicator = Volume(values, grid.origin, spacing)
    mesh = isosurface(indicator, used)
    reach = SUPPORT_RADIUS * cloud.pitch * spacing
    mesh = supported_parts(mesh, place, energy, reach=reach, spacing=spacing)
    return mesh, indicator, used


def _check(
    points: NDArray[np.float64],
    energies: NDArray[np.float64],
    normals: NDArray[np.float64],
    smoothing: float,
) -> None:
    count = len(points)
    if points.shape != (count, 3) or energies.shape != (count,) or normals.shape != (count, 3):
        raise ValueError(
            f"points {points.shape}, energies {energies.shape}, normals {normals.shape}: "
            "expected (N, 3), (N,) and (N, 3)"
        )
    if not smoothing > 0:
        raise ValueError(f"smoothing: {smoothing}, expected more than 0 voxels")
    for name, values in (("points", points), ("energies", energies), ("normals", normals)):
        if not np.isfinite(values).all():
            raise NumericalError(f"{name} hold values that are not finite; the fit has diverged")
    if (energies < 0).any():
        raise ValueError("energies: expected zero or more")
