# SPDX-License-Identifier: MIT
"""Start surfaces: from echoes, and from a fitted field if there is one."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, field
from typing import Literal

import numpy as np
import torch
import trimesh
from scipy import ndimage, sparse
from scipy.ndimage import uniform_filter
from scipy.sparse.linalg import spsolve
from torch import Tensor

from sononerf.echoes.detection import RangeLevels
from sononerf.echoes.echoes import Echoes
from sononerf.echoes.free_space import EchoHull
from sononerf.errors import NumericalError, SettingsError
from sononerf.field.field import Field
from sononerf.geometry.lattice import (
    Volume,
    automatic_level,
    grid_over,
    isosurface,
    level_surface,
    volume_from_function,
)
from sononerf.numerics import Bools, Floats
from sononerf.start.evidence import ALIGNED
from sononerf.start.network import levels_surfaces
from sononerf.start.occupancy import Gathered, estimate_occupancy, gather_evidence

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
    r"""Return a thin body as two parallel heights over a plane.

    A sheet sends echoes like a mirror, so most poses hear only its rim. Few hear its sides, and the
    onsets of the others leave the hollows of a bent sheet closed. But the hollow side and the other
    one have the same shape. So a height :math:`z` over the plane of the sheet is fitted to the
    evidence of both sides:

    .. math::
        E(z) = \sum_i w_i\, \rho(z(u_i) \pm d - z_i) + \lambda \int |\mathrm{D}^2 z|^2
               + \text{onsets: the sheet lies in the hull, and at its thin rim in the middle}

    with half of the thickness :math:`d` and the loss of Geman and McClure :math:`\rho`, whose scale
    falls from round to round (graduated non-convexity [1]_). The bending energy is that of a thin
    plate.

    References:
        .. [1] A. Blake, A. Zisserman, "Visual Reconstruction", MIT Press, 1987.
    """
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
    """Return the columns that the hull fills, with the lower and upper end, (U V,) each, m."""
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


_FAINTEST = (
    1e-7  # fraction of the loudest place's energy; quieter places are left out, to save time
)
_CHUNK = 16_384  # places at a time, a bound of memory

StartMethod = Literal["open", "filled", "hull", "sheet", "levels", "fuller", "given"]
"""Method of a start surface. The first three are the surface of the occupancy
(:mod:`sononerf.start.occupancy`); ``sheet`` is one thin body
(:mod:`sononerf.start.read_out`); ``levels`` is that of a network, and the only one that needs
no fitted field (:mod:`sononerf.start.network`). ``fuller`` is that of the network with gaps
closed; the refinement of ``levels`` begins with it too. ``given`` is a surface of the user's."""
LEVELS: tuple[StartMethod, ...] = ("levels", "fuller")
"""Start surfaces that the network makes at once."""
Method = StartMethod | Literal["isosurface"]
"""A start method, or ``isosurface``: a level of the field's volume."""


STARTS: tuple[StartMethod, ...] = ("open", "filled", "hull", *LEVELS, "sheet")
"""Start surfaces that a refinement tries; how far they lie apart is part of the error of the
surface."""


@dataclass(frozen=True, eq=False)
class Reading:
    """All that start surfaces are made of."""

    hull: EchoHull  # The onsets and the poses that they were heard from
    box: Floats  # (2, 3), m: Lower and upper corner of the region
    resolution: float  # m: Range resolution
    # Levels of the echoes over range; None if only the free space is known
    levels: RangeLevels | None = None
    volume: Volume | None = None  # Energy of the field; None without a field, like the next one
    gathered: Gathered | None = None  # Evidence of field and onsets
    methods: tuple[StartMethod, ...] = STARTS  # Start surfaces that a refinement tries
    # Start surfaces that were made of it, by method
    starts: dict[StartMethod, trimesh.Trimesh] = field(default_factory=dict, repr=False)


def read_field(
    field: Field,
    hull: EchoHull,
    *,
    resolution: float,
    spacing: float | None = None,
    directions: int = 100,
    levels: RangeLevels | None = None,
    progress: Callable[[int, int], None] | None = None,
) -> Reading:
    """Read volume and evidence out of a field. In: resolution (m), spacing (m)."""
    lower, upper, step = _grid_of(field, spacing)
    energy = _energy(field, directions)
    volume = volume_from_function(energy, lower, upper, step, chunk=_CHUNK, progress=progress)
    places = _places(field, lower, upper, directions)
    known = gather_evidence(field, places, hull, lower, upper, step, resolution)
    return Reading(hull, np.stack([lower, upper]), resolution, levels, volume, known)


def read_echoes(echoes: Echoes) -> Reading:
    """Return the data of start surfaces without a field."""
    box = echoes.region.box() if echoes.box is None else echoes.box
    return Reading(echoes.hull, box, echoes.head.resolution, echoes.levels, methods=LEVELS)


def start_surfaces(
    reading: Reading, methods: Sequence[StartMethod]
) -> Iterator[tuple[StartMethod, trimesh.Trimesh]]:
    """Yield each method that gives a surface, and its closed mesh, m."""
    first: NumericalError | None = None
    any_surface = False
    for method in methods:
        try:
            if method not in reading.starts:
                reading.starts[method] = _start(reading, method)
        except NumericalError as error:
            first = first or error
            continue
        any_surface = True
        yield method, reading.starts[method]
    if first is not None and not any_surface:
        raise first


def _start(reading: Reading, method: StartMethod) -> trimesh.Trimesh:
    if method == "levels" or method == "fuller":
        made = levels_surfaces(reading.levels, reading.hull, reading.box, reading.resolution)
        reading.starts.update(zip(LEVELS, made, strict=True))
        return reading.starts[method]
    if reading.gathered is None:
        raise NumericalError(f"the start {method} needs a fitted field; without one take levels")
    if method == "sheet":
        return fit_sheet(reading.gathered)
    assert method != "given"  # nothing is read out for it
    return estimate_occupancy(reading.gathered, method)


def read_isosurface(
    field: Field,
    *,
    spacing: float | None = None,
    level: float | Literal["auto"] = "auto",
    directions: int = 100,
    smoothing: float = 0.0,
    progress: Callable[[int, int], None] | None = None,
) -> tuple[trimesh.Trimesh, Volume, float]:
    """Return an iso-surface of a field's loudness, the volume it lies in, and its level.

    In: smoothing (m).
    """
    lower, upper, step = _grid_of(field, spacing)
    loudness = _loudness(field, directions)
    volume = volume_from_function(loudness, lower, upper, step, chunk=_CHUNK, progress=progress)
    if not float(volume.values.max()) > 0:
        raise NumericalError("no surface: the field is silent everywhere")
    width = 2 * int(smoothing / volume.spacing / 2) + 1
    if width > 1:
        volume = volume.with_values(uniform_filter(volume.values, width, mode="nearest"))
    starts = automatic_level(volume) if level == "auto" else level
    return isosurface(volume, starts), volume, starts


def _grid_of(field: Field, spacing: float | None) -> tuple[Floats, Floats, float]:
    """Return lower and upper corner (3,) of a field's region, and the voxel size, m."""
    lower, upper = (corner.cpu().double().numpy() for corner in field.region)
    step = spacing or field.resolution / 2
    narrowest = float((upper - lower).min())
    if step > narrowest:
        raise SettingsError(
            f"a spacing of {step:g} m is larger than the region ({narrowest:.3g} m at its "
            "narrowest); give metres"
        )
    return lower, upper, step


def energy_volume(field: Field, spacing: float, directions: int) -> Volume:
    """Return the energy of a field on a grid over its region. In: spacing (m)."""
    lower, upper = (corner.cpu().double().numpy() for corner in field.region)
    return volume_from_function(_energy(field, directions), lower, upper, spacing, chunk=_CHUNK)


def _energy(field: Field, directions: int) -> Callable[[Floats], Floats]:
    return _inside(field, lambda places: field.oriented(places, directions)[0])


def _loudness(field: Field, directions: int) -> Callable[[Floats], Floats]:
    return _inside(field, lambda places: field.loudness(places, directions))


def _inside(field: Field, function: Callable[[Tensor], Tensor]) -> Callable[[Floats], Floats]:
    """Return a function of points that is zero where the field has no places."""

    def values_at(points: Floats) -> Floats:
        places = torch.as_tensor(points, dtype=field.region.dtype, device=field.region.device)
        inside = field.inside(places)
        values = places.new_zeros(len(places))
        if bool(inside.any()):
            values[inside] = function(places[inside])
        return np.asarray(values.cpu().numpy(), dtype=np.float64)

    return values_at


def _places(field: Field, lower: Floats, upper: Floats, directions: int) -> Tensor:
    """Return the field's own vertices that are not silent, (N, 3) m."""
    points = grid_over(lower, upper, field.resolution).points()
    # From the region's corner, where the field's own vertices lie.
    points = points - points[0] + lower
    places = torch.as_tensor(points, dtype=field.region.dtype, device=field.region.device)
    places = places[field.inside(places)]
    energy = torch.cat([field.oriented(part, directions)[0] for part in places.split(_CHUNK)])
    return places[energy > _FAINTEST * energy.amax()] if len(energy) else places
