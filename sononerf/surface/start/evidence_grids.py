# SPDX-License-Identifier: MIT
"""Oriented points on a lattice: thin places, distance to their planes, winding number."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray
from scipy import fft, ndimage

from sononerf.geometry.lattice import Grid, Lattice

Array = NDArray[np.float64]
_DENSE = 0.2  # density, over the median at the points, at which a plane has half of its full weight
_PLANE = 1.0  # voxels, standard deviation of the Gaussian over which a point's plane counts
_LOCAL = 3.0  # voxels over which the density of points is measured
_BLUR = 1.5  # voxels over which normals are averaged to find out where opposite ones cancel


def thinness(lattice: Lattice, points: Array, normals: Array, weight: Array) -> Grid:
    """Return where the other side of the body is so close that both would cancel, from 0 to 1.

    There the blurred normals are short beside the blurred weights, or point the other way behind a
    point. In a narrow gap they do so in front of it.

    Args:
        lattice: The voxels.
        points, normals (G, 3): Oriented points, m and unit vectors.
        weight (G,): How far they are believed.

    Returns:
        thin: (X, Y, Z).
    """
    if not len(points):
        return np.zeros(lattice.shape, np.float32)
    total = lattice.spread(points, weight, _BLUR)
    blurred = [lattice.spread(points, weight * along, _BLUR) for along in normals.T]

    def agreement(shift: float) -> Array:
        where = points + shift * lattice.spacing * normals
        along = sum(
            n * lattice.read(grid, where) for n, grid in zip(normals.T, blurred, strict=True)
        )
        return np.asarray(along / np.maximum(lattice.read(total, where), 1e-12))

    here, behind, before = agreement(0.0), agreement(-2.0), agreement(2.0)
    # One smooth side alone agrees by more than 0.6 with its mean normal; two sides by less.
    cancels = ((0.6 - here) / 0.4).clip(0, 1) * (before >= behind)
    backed = ((-behind - 0.2) / 0.4).clip(0, 1)
    wide = lattice.spread(points, weight, 2.0)
    thin = lattice.spread(points, weight * np.maximum(cancels, backed), 2.0)
    return np.asarray(thin / np.maximum(wide, 1e-3 * wide.max() + 1e-30), dtype=np.float32)


def planes(lattice: Lattice, points: Array, normals: Array, weight: Array) -> tuple[Grid, Grid]:
    """Return how far voxels near points are known, and their distance to the planes.

    Args:
        lattice: The voxels.
        points, normals (G, 3): Oriented points, m and unit vectors.
        weight (G,): How far they are believed.

    Returns:
        known (X, Y, Z): From 0 to 1.
        target ((X, Y, Z), voxels): Mean distance to the planes of the points around, positive on
            the side of the normals.
    """
    size = int(np.prod(lattice.shape))
    total, moment = np.zeros(size), np.zeros(size)
    place = lattice.coordinates(points)
    nearest = np.rint(place).astype(np.intp)
    for step in np.ndindex(5, 5, 5):
        voxel = nearest + np.asarray(step) - 2
        off = voxel - place
        within = ((voxel >= 0) & (voxel < np.asarray(lattice.shape))).all(axis=1)
        near = weight * np.exp(-0.5 * (off**2).sum(axis=1) / _PLANE**2)
        flat = np.ravel_multi_index(tuple(voxel[within].T), lattice.shape)
        total += np.bincount(flat, near[within], size)
        moment += np.bincount(flat, (near * (off * normals).sum(axis=1))[within], size)
    target = (moment / np.maximum(total, 1e-12)).reshape(lattice.shape).astype(np.float32)
    known = total.reshape(lattice.shape)
    if len(points):
        known /= known + _DENSE * np.median(lattice.read(known, points)) + 1e-30
    return known.astype(np.float32), target


def winding_of(lattice: Lattice, points: Array, normals: Array, weight: Array) -> Grid:
    """Return the winding number of oriented points, each place of the surface counted once.

    Args:
        lattice: The voxels.
        points, normals (G, 3): Oriented points, m and unit vectors; at least one.
        weight (G,): Their power. It is divided by the power around, so that loud places count no
            more than others.

    Returns:
        winding (X, Y, Z): About 1 inside of a body, 0 outside, negative where mostly backs of
            surfaces are seen.
    """
    around = lattice.spread(points, weight, _LOCAL)
    # A plane of density 1 has this value at its points when it is blurred.
    unit = np.sqrt(2 * np.pi) * _LOCAL
    level = unit * (around + 0.05 * np.median(lattice.read(around, points)))
    flux = [
        lattice.spread(points, weight * along, 1.0) / level.astype(np.float32)
        for along in normals.T
    ]
    return np.asarray(ndimage.gaussian_filter(winding_number(flux), 1.0), dtype=np.float32)


_AIR = 0.25  # fraction of the longest side, empty on each side: periodic images must stay apart


def winding_number(flux: Sequence[Grid]) -> Grid:
    """Return the winding number of a density of surface.

    Args:
        flux (three (X, Y, Z) float, 1/voxel): Area per volume along outward normals: across a
            surface it adds up to one.

    Returns:
        winding (X, Y, Z): Zero far away.
    """
    shape = flux[0].shape
    air = 2 * round(_AIR * max(shape))
    size = [int(fft.next_fast_len(n + air, real=True)) for n in shape]
    square = np.zeros(1, np.float32)
    total = np.zeros(1, np.complex64)
    for axis, n in enumerate(size):
        frequency = np.fft.rfftfreq(n) if axis == 2 else np.fft.fftfreq(n)
        wave = (2 * np.pi * frequency).astype(np.float32)
        wave = wave.reshape([-1 if a == axis else 1 for a in range(3)])
        square = square + wave**2
        total = total + wave * fft.rfftn(flux[axis], s=size)
    square[0, 0, 0] = 1.0  # the mean is set below
    found = fft.irfftn(1j * total / square, s=size)
    far = [
        found.take((inner + whole) // 2, axis).mean()
        for axis, (inner, whole) in enumerate(zip(shape, size, strict=True))
    ]
    x, y, z = shape
    return np.asarray(found[:x, :y, :z] - np.mean(far), dtype=np.float32)
