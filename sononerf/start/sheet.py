# SPDX-License-Identifier: MIT
r"""A thin body as two parallel heights over a plane.

A sheet sends echoes like a mirror, so most poses hear only its rim. Few hear its sides, and the
onsets of the others leave the hollows of a bent sheet closed. But the hollow side and the other one
have the same shape. So a height :math:`z` over the plane of the sheet is fitted to the evidence of
both sides:

.. math::
    E(z) = \sum_i w_i\, \rho(z(u_i) \pm d - z_i) + \lambda \int |\mathrm{D}^2 z|^2
           + \text{onsets: the sheet lies in the hull, and at its thin rim in the middle}

with half of the thickness :math:`d` and the loss of Geman and McClure :math:`\rho`, whose scale
falls from round to round (graduated non-convexity [1]_). The bending energy is that of a thin
plate.

References:
    .. [1] A. Blake, A. Zisserman, "Visual Reconstruction", MIT Press, 1987.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import trimesh
from scipy import ndimage, sparse
from scipy.sparse.linalg import spsolve

from sononerf.errors import NumericalError
from sononerf.geometry.lattice import level_surface
from sononerf.numerics import Bools, Floats
from sononerf.start.evidence import ALIGNED
from sononerf.start.occupancy import Gathered

MAX_SHEET_THICKNESS = 0.7
"""Distance of the other side below which a place is thin, range resolutions. The sides of a sheet
share one echo, so neither is known to better than a fraction of the resolution."""
MIN_SHEET_FRACTION = 0.5
"""Least fraction of the evidence that lies on the sheet."""
SMOOTHING_LENGTH = 0.5
"""Length over which a sheet bends as easily as the evidence is dense, range resolutions."""
_LEAST = 0.05  # range resolutions, half of the least thickness; only keeps the sides apart
_FACING = 0.3  # cosine to the plane's normal, below which evidence is of the rim
_ROUNDS = 24  # of reweighting
_SETTLED = 12  # rounds with the last scale
_FIRST, _LAST = 3.0, 0.15  # range resolutions, scale of the loss in the first and last rounds
_COLUMNS = 8000  # of the grid, a bound of time
_HELD = 0.3  # weight of the hull's middle where the hull is thinner than a voxel
_DENSITY = 3.0  # columns over which the density of points is measured


@dataclass(frozen=True, eq=False)
class _Frame:
    """A grid in the plane of the sheet, and its height above that plane."""

    centre: Floats  # (3,), (3, 3): Origin, m, and the directions along, across and above as columns
    axes: Floats
    lower: Floats  # (2,): Lower corner of the grid, m
    step: float  # m
    depth: Floats  # (U, V, Z): Greatest depth below the onsets, m, positive inside
    heights: Floats  # (Z,): m


def fit_sheet(gathered: Gathered) -> trimesh.Trimesh:
    """Return the sheet that the evidence lies on."""
    evidence, weight, resolution = gathered.evidence, gathered.weight, gathered.resolution
    frame = _framed(gathered)
    shape = frame.depth.shape[:2]
    place = (evidence.points - frame.centre) @ frame.axes
    normal = evidence.normals @ frame.axes
    at = (place[:, :2] - frame.lower) / frame.step
    used = (np.abs(normal[:, 2]) > _FACING) & (weight > 0)
    used &= ((at >= 0) & (at <= np.asarray(shape) - 1)).all(axis=1)
    if not used.any():
        raise NumericalError("no surface: nothing was heard of the sides of a sheet")
    at, height, weight = at[used], place[used, 2], weight[used]
    side = np.sign(normal[used, 2])
    read = _linear(at, shape)
    dense = ndimage.gaussian_filter((read.T @ weight).reshape(shape), _DENSITY).ravel()
    dense = read @ dense
    weight = weight / (dense + 0.2 * np.median(dense))
    within, low, high = _hull_heights(frame)
    middle = np.where(within, (low + high) / 2, 0.0)
    thin = _HELD * np.exp(-0.5 * ((high - low) / (2 * frame.step)) ** 2) * within
    held = thin + 1e-6
    stiffness = (SMOOTHING_LENGTH * resolution / frame.step) ** 4
    bending = _bending(shape)
    half = _LEAST * resolution
    z = middle
    for turn in range(_ROUNDS):
        part = min(turn / (_ROUNDS - _SETTLED), 1.0)
        scale = resolution * _FIRST * (_LAST / _FIRST) ** part
        off = read @ z + side * half - height
        counts = weight / (1 + (off / scale) ** 2) ** 2
        beyond = within & ((z > high) | (z < low))
        matrix = (
            read.T @ sparse.diags_array(counts) @ read
            + stiffness * bending
            + sparse.diags_array(held + beyond)
        )
        right = read.T @ (counts * (height - side * half))
        right += held * middle + np.where(beyond, z.clip(low, high), 0.0)
        z = spsolve(matrix.tocsc(), right)
        half = float(np.average(side * (height - read @ z), weights=counts))
        half = max(half, _LEAST * resolution)
        if scale < resolution and half > MAX_SHEET_THICKNESS * resolution:
            break  # twice too thick
    near = np.abs(read @ z + side * half - height) < ALIGNED * resolution
    if (
        2 * half > MAX_SHEET_THICKNESS * resolution
        or np.average(near, weights=weight) < MIN_SHEET_FRACTION
    ):
        raise NumericalError("no surface: the evidence does not lie on one sheet")
    return _slab(frame, z.reshape(shape), half)


def _framed(gathered: Gathered) -> _Frame:
    """Return the grid over the places that the onsets leave, above its plane."""
    lattice = gathered.lattice
    inside = lattice.origin + lattice.spacing * np.argwhere(gathered.bound < 0)
    if len(inside) < 4:
        raise NumericalError("no surface: the onsets leave no room for a sheet")
    centre = inside.mean(axis=0)
    axes = np.linalg.eigh(np.cov((inside - centre).T))[1][:, ::-1]
    place = (inside - centre) @ axes
    lower, upper = place.min(axis=0), place.max(axis=0)
    area = float(np.prod(upper[:2] - lower[:2]))
    step = max(lattice.spacing, (area / _COLUMNS) ** 0.5)
    lower, upper = lower - 4 * step, upper + 4 * step
    along, across, heights = (
        np.arange(a, b + step, step) for a, b in zip(lower, upper, strict=True)
    )
    grid = np.stack(np.meshgrid(along, across, heights, indexing="ij"), axis=-1)
    depth = -lattice.spacing * lattice.read(gathered.bound, grid.reshape(-1, 3) @ axes.T + centre)
    return _Frame(centre, axes, lower[:2], step, depth.reshape(grid.shape[:3]), heights)


def _hull_heights(frame: _Frame) -> tuple[Bools, Floats, Floats]:
    """Return which columns the hull fills, with the lower and upper end, (U V,) each, m."""
    inside = frame.depth > 0
    first = frame.heights[inside.argmax(axis=2)]
    last = frame.heights[::-1][inside[:, :, ::-1].argmax(axis=2)]
    return inside.any(axis=2).ravel(), first.ravel(), last.ravel()


def _linear(at: Floats, shape: tuple[int, ...]) -> sparse.csr_array:
    """Return the matrix that reads a grid at places (N, 2), linearly between columns."""
    base = np.floor(at).astype(np.intp).clip(0, np.asarray(shape) - 2)
    fraction = at - base
    row, column, value = [], [], []
    for corner in np.ndindex(2, 2):
        value.append(np.prod(np.where(corner, fraction, 1 - fraction), axis=1))
        column.append(np.ravel_multi_index(tuple((base + np.asarray(corner)).T), shape))
        row.append(np.arange(len(at)))
    entries = (np.concatenate(value), (np.concatenate(row), np.concatenate(column)))
    return sparse.csr_array(entries, shape=(len(at), int(np.prod(shape))))


def _bending(shape: tuple[int, ...]) -> sparse.csr_array:
    """Return the matrix of a thin plate's energy on a grid of unit step."""
    once = [sparse.diags_array([-1.0, 1.0], offsets=[0, 1], shape=(n - 1, n)) for n in shape]
    twice = [
        sparse.diags_array([1.0, -2.0, 1.0], offsets=[0, 1, 2], shape=(n - 2, n)) for n in shape
    ]
    along = sparse.kron(twice[0], sparse.eye_array(shape[1]))
    across = sparse.kron(sparse.eye_array(shape[0]), twice[1])
    twist = sparse.kron(once[0], once[1])
    return sparse.csr_array(along.T @ along + across.T @ across + 2.0 * twist.T @ twist)


def _slab(frame: _Frame, z: Floats, half: float) -> trimesh.Trimesh:
    """Return the body between two heights, as far as the hull reaches."""
    # Made as a flat slab of two layers, then put at its heights: the sides cannot touch.
    layers = np.abs(np.arange(-3, 4)) - 1.0
    deepest = ndimage.gaussian_filter(frame.depth.max(axis=2), 0.7) / frame.step
    outside = np.maximum(layers[None, None], -deepest[:, :, None])
    if not (outside < 0).any():
        raise NumericalError("no surface: the onsets leave no room for a sheet")
    slab = level_surface(outside, 0.0)
    where, layer = slab.vertices[:, :2], slab.vertices[:, 2] - 3.0
    height = ndimage.map_coordinates(z, where.T, order=1) + layer * half
    place = np.column_stack((frame.lower + frame.step * where, height))
    sheet = trimesh.Trimesh(place @ frame.axes.T + frame.centre, slab.faces, process=False)
    largest = max(sheet.split(only_watertight=False), key=lambda part: len(part.faces))
    if largest.volume < 0:
        largest.invert()
    return largest
