# SPDX-License-Identifier: MIT
"""The volume and the iso-surfaces of a fitted field."""

from __future__ import annotations

from collections.abc import Callable
from typing import Literal

import numpy as np
import torch
import trimesh
from scipy.ndimage import uniform_filter
from torch import Tensor

from sononerf.errors import NumericalError, SettingsError
from sononerf.field.field import Field
from sononerf.geometry.lattice import Volume, automatic_level, isosurface, volume_from_function
from sononerf.numerics import Floats

_CHUNK = 16_384  # places at a time, a bound of memory


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
    loudness = _inside(field, lambda places: field.loudness(places, directions))
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


def energy_volume(
    field: Field,
    spacing: float | None,
    directions: int,
    progress: Callable[[int, int], None] | None = None,
) -> Volume:
    """Return the energy of a field on a grid over its region.

    In: spacing (m; half of the field's resolution where None).
    """
    lower, upper, step = _grid_of(field, spacing)
    energy = _inside(field, lambda places: field.energy(places, directions))
    return volume_from_function(energy, lower, upper, step, chunk=_CHUNK, progress=progress)


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
