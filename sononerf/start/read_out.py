# SPDX-License-Identifier: MIT
"""From echoes, and a fitted field if there is one, to the start surfaces."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, field
from typing import Literal

import numpy as np
import torch
import trimesh
from scipy.ndimage import uniform_filter
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
    volume_from_function,
)
from sononerf.numerics import Floats
from sononerf.start.network import levels_surfaces
from sononerf.start.occupancy import Gathered, estimate_occupancy, gather_evidence
from sononerf.start.sheet import fit_sheet

_FAINTEST = (
    1e-7  # fraction of the loudest place's energy; quieter places are left out, to save time
)
_CHUNK = 16_384  # places at a time, a bound of memory

StartMethod = Literal["open", "filled", "hull", "sheet", "levels", "fuller", "given"]
"""Method of a start surface. The first three are the surface of the occupancy
(:mod:`sononerf.start.occupancy`); ``sheet`` is one thin body
(:mod:`sononerf.start.sheet`); ``levels`` is that of a network, and the only one that needs
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
    """Read volume and evidence out of a field.

    In: resolution (m), spacing (m).
    """
    lower, upper, step = _grid_of(field, spacing)
    energy = _energy(field, directions)
    volume = volume_from_function(energy, lower, upper, step, chunk=_CHUNK, progress=progress)
    places = _places(field, lower, upper, directions)
    known = gather_evidence(field, places, hull, lower, upper, step, resolution)
    return Reading(hull, np.stack([lower, upper]), resolution, levels, volume, known)


def read_echoes(echoes: Echoes) -> Reading:
    """Return what start surfaces are made of where there is no field."""
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
    """Return the energy of a field on a grid over its region.

    In: spacing (m).
    """
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
