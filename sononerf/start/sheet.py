# SPDX-License-Identifier: MIT
"""A thin body as a height over a plane: a start surface of bent sheets, such as leaves.

In: what the network makes of the echoes, and the room that the onsets leave. Out: a closed mesh, m.
A sheet sends echoes like a mirror, so most poses hear only its rim, and the network knows its place
less exactly than it is thick. But it is one smooth surface, to which all that the network finds
contributes. Section 4 of ``docs/method.md``.

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
from sononerf.geometry.lattice import Lattice, level_surface
from sononerf.numerics import Bools, Floats, Singles

SHEET_THICKNESS = 0.24
"""Thickness of the start surface of a sheet, range resolutions: about a voxel, the least that the
refinement can extract anew. With half and with twice of it a leaf has the same F-score to 0.04."""
SMOOTHING_LENGTH = 0.5
"""Length over which a sheet bends as easily as what is found of it is dense, range resolutions."""
NEAR_SHEET = 0.3
"""Distance from the sheet within which a place lies on it, range resolutions."""
MIN_SHEET_SHARE = 0.3
"""Least share of the probability that lies on the sheet. On a leaf and a bent plate it is 0.44 and
0.45, on tower, cone and a body of bars 0.09 to 0.14. A plate of two range resolutions has 0.3; the
refinement then tells what is right."""
_POSSIBLE = 0.05  # probability of a place that takes part, at least
_ROUNDS, _SETTLED = 24, 12  # of reweighting, and those with the last scale
_FIRST, _LAST = 3.0, 0.15  # range resolutions, scale of the loss in the first and last rounds
_COLUMNS = 8000  # of the grid, a bound of time
_HELD = 0.3  # weight of the middle of the room where it is thinner than a voxel
_DENSITY = 3.0  # columns over which the density of places is measured
_MARGIN = 4  # columns around the room


@dataclass(frozen=True, eq=False)
class _Grid:
    """Columns over the plane of the sheet."""

    centre: Floats  # (3,), m
    axes: Floats  # (3, 3): Directions along, across and above as columns
    lower: Floats  # (2,), m: Lower corner
    step: float  # m
    depth: Floats  # (U, V, Z), m: Depth in the room, positive inside
    heights: Floats  # (Z,), m

    @classmethod
    def over(cls, room: Floats, lattice: Lattice) -> _Grid:
        """Return the columns over the plane of the two longest axes of a room."""
        inside = lattice.origin + lattice.spacing * np.argwhere(room > 0)
        if len(inside) < 4:
            raise NumericalError("no surface: the onsets leave no room for a sheet")
        centre = inside.mean(axis=0)
        axes = np.linalg.eigh(np.cov((inside - centre).T))[1][:, ::-1]
        place = (inside - centre) @ axes
        lower, upper = place.min(axis=0), place.max(axis=0)
        step = max(lattice.spacing, float(np.prod((upper - lower)[:2]) / _COLUMNS) ** 0.5)
        sides = (
            np.arange(a - _MARGIN * step, b + (_MARGIN + 1) * step, step)
            for a, b in zip(lower, upper, strict=True)
        )
        along, across, heights = sides
        grid = np.stack(np.meshgrid(along, across, heights, indexing="ij"), axis=-1)
        depth = lattice.read(room.astype(np.float32), grid.reshape(-1, 3) @ axes.T + centre)
        corner = np.array([along[0], across[0]])
        return cls(centre, axes, corner, step, depth.reshape(grid.shape[:3]), heights)

    def room(self) -> tuple[Bools, Floats, Floats]:
        """Return the columns with room, and its lower and upper end, (U V,) each, m."""
        inside = self.depth > 0
        first = self.heights[inside.argmax(axis=2)]
        last = self.heights[::-1][inside[:, :, ::-1].argmax(axis=2)]
        return inside.any(axis=2).ravel(), first.ravel(), last.ravel()


def fit_sheet(
    probability: Singles, room: Floats, lattice: Lattice, resolution: float
) -> trimesh.Trimesh:
    r"""Return a thin body, two parallel heights over a plane.

    The height :math:`z` over the plane is fitted to the places :math:`i` with their probabilities
    :math:`w_i` of being inside, over the density of places:

    .. math::
        E(z) = \sum_i w_i\, \rho(z(u_i) - z_i) + \lambda \int |\mathrm{D}^2 z|^2
               + \text{onsets: the sheet lies in the room, and at its thin rim in the middle}

    with the loss of Geman and McClure :math:`\rho`, whose scale falls from round to round
    (graduated non-convexity [1]_). The bending energy is that of a thin plate.

    In: probability (X, Y, Z), room ((X, Y, Z), m: depth behind the onsets), resolution (m).

    Raises:
        NumericalError: If what was found does not lie on one sheet.
    """
    grid = _Grid.over(room, lattice)
    shape = grid.depth.shape[:2]
    voxels = np.argwhere(probability > _POSSIBLE)
    weight = probability[tuple(voxels.T)].astype(np.float64)
    place = (lattice.origin + lattice.spacing * voxels - grid.centre) @ grid.axes
    at = (place[:, :2] - grid.lower) / grid.step
    used = ((at >= 0) & (at <= np.asarray(shape) - 1)).all(axis=1)
    if not used.any():
        raise NumericalError("no surface: nothing was found of a sheet")
    height, weight, read = place[used, 2], weight[used], _linear(at[used], shape)
    dense = read @ ndimage.gaussian_filter((read.T @ weight).reshape(shape), _DENSITY).ravel()
    weight = weight / (dense + 0.2 * np.median(dense))
    within, low, high = grid.room()
    middle = np.where(within, (low + high) / 2, 0.0)
    held = _HELD * np.exp(-0.5 * ((high - low) / (2 * grid.step)) ** 2) * within + 1e-6
    bending = (SMOOTHING_LENGTH * resolution / grid.step) ** 4 * _bending(shape)
    z = middle
    for turn in range(_ROUNDS):
        scale = resolution * _FIRST * (_LAST / _FIRST) ** min(turn / (_ROUNDS - _SETTLED), 1.0)
        counts = weight / (1 + ((read @ z - height) / scale) ** 2) ** 2
        beyond = within & ((z > high) | (z < low))
        matrix = read.T @ sparse.diags_array(counts) @ read
        matrix = matrix + bending + sparse.diags_array(held + beyond)
        right = read.T @ (counts * height) + held * middle
        z = spsolve(matrix.tocsc(), right + np.where(beyond, z.clip(low, high), 0.0))
    near = np.abs(read @ z - height) < NEAR_SHEET * resolution
    if np.average(near, weights=weight) < MIN_SHEET_SHARE:
        raise NumericalError("no surface: what was found does not lie on one sheet")
    return _slab(grid, z.reshape(shape), SHEET_THICKNESS / 2 * resolution)


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


def _slab(grid: _Grid, z: Floats, half: float) -> trimesh.Trimesh:
    """Return the body between two heights, as far as the room reaches."""
    # Made as a flat slab of two layers, then put at its heights: the sides cannot touch.
    layers = np.abs(np.arange(-3, 4)) - 1.0
    deepest = ndimage.gaussian_filter(grid.depth.max(axis=2), 0.7) / grid.step
    outside = np.maximum(layers[None, None], -deepest[:, :, None])
    if not (outside < 0).any():
        raise NumericalError("no surface: the onsets leave no room for a sheet")
    slab = level_surface(outside, 0.0)
    where, layer = slab.vertices[:, :2], slab.vertices[:, 2] - 3.0
    height = ndimage.map_coordinates(z, where.T, order=1) + layer * half
    place = np.column_stack((grid.lower + grid.step * where, height))
    sheet = trimesh.Trimesh(place @ grid.axes.T + grid.centre, slab.faces, process=False)
    largest = max(sheet.split(only_watertight=False), key=lambda part: len(part.faces))
    if largest.volume < 0:
        largest.invert()
    return largest
