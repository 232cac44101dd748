# SPDX-License-Identifier: MIT
"""From a fitted field to a volume and a surface."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Literal

import numpy as np
import torch
import trimesh
from numpy.typing import NDArray

from sononerf.errors import NumericalError, SettingsError
from sononerf.field.field import Field
from sononerf.reconstruction.isosurface import automatic_level, isosurface
from sononerf.reconstruction.oriented import oriented_surface
from sononerf.reconstruction.volume import Volume, grid_over, volume_from_function

Array = NDArray[np.float64]
FAINTEST = 1e-7
"""Places this far below the loudest take no part in the oriented surface."""
CHUNK = 16_384


@dataclass(frozen=True)
class Reconstruction:
    """What a field was read out to."""

    mesh: trimesh.Trimesh
    volume: Volume
    level: float
    method: Literal["oriented", "isosurface"]


def reconstruct(
    field: Field,
    *,
    spacing: float | None = None,
    level: float | Literal["auto"] = "auto",
    method: Literal["auto", "oriented", "isosurface"] = "auto",
    directions: int = 100,
    progress: Callable[[int, int], None] | None = None,
) -> Reconstruction:
    """Read volume and surface out of a field.

    Parameters
    ----------
    field : Field
        What was fitted.
    spacing : float or None, m
        Voxel size; half of the field's own resolution where None.
    level : float or "auto"
        Value of the volume, or of the oriented indicator, on the surface.
    method : {"auto", "oriented", "isosurface"}
        ``auto`` is the oriented surface where the field knows directions.
    directions : int
        Size of the spherical lattice that is summed over where the field has no lobes.
    progress : callable, optional
        Called with the voxels done and the voxels in all.

    Returns
    -------
    reconstruction : Reconstruction

    Raises
    ------
    SettingsError
        If the spacing is larger than the region.
    NumericalError
        If the field is silent everywhere, or there is no surface at the level.
    ResourceError
        If the grid does not fit in memory.
    """
    lower, upper = (corner.double().cpu().numpy() for corner in field.region)
    step = spacing or field.resolution / 2
    if step > float((upper - lower).min()):
        raise SettingsError(
            f"a spacing of {step:g} m is larger than the region ({(upper - lower).min():.3g} m "
            "at its narrowest); give metres"
        )
    if method == "auto":
        method = "oriented" if field.knows_directions else "isosurface"
    volume = volume_from_function(
        _loudness(field, directions, method), lower, upper, step, chunk=CHUNK, progress=progress
    )
    if not float(volume.values.max()) > 0:
        raise NumericalError("no surface: the field is silent everywhere")
    if method == "oriented":
        mesh, _, found = _oriented(field, lower, upper, step, level, directions)
    else:
        found = automatic_level(volume) if level == "auto" else level
        mesh = isosurface(volume, found)
    return Reconstruction(mesh, volume, found, method)


def _loudness(
    field: Field, directions: int, method: Literal["oriented", "isosurface"]
) -> Callable[[Array], Array]:
    def loudness(points: Array) -> Array:
        places = torch.as_tensor(points, dtype=field.region.dtype, device=field.region.device)
        inside = field.inside(places)
        values = places.new_zeros(len(places))
        if bool(inside.any()):
            if method == "oriented":
                values[inside] = field.oriented(places[inside], directions)[0]
            else:
                values[inside] = field.loudness(places[inside], directions)
        return np.asarray(values.cpu().numpy(), dtype=np.float64)

    return loudness


def _oriented(
    field: Field,
    lower: Array,
    upper: Array,
    step: float,
    level: float | Literal["auto"],
    directions: int,
) -> tuple[trimesh.Trimesh, Volume, float]:
    points = grid_over(lower, upper, field.resolution).points()
    # From the region's corner, where the field's own vertices lie.
    points = points - points[0] + lower
    places = torch.as_tensor(points, dtype=field.region.dtype, device=field.region.device)
    places = places[field.inside(places)]
    energies, axes = [], []
    for part in places.split(CHUNK):
        energy, axis = field.oriented(part, directions)
        energies.append(energy)
        axes.append(axis)
    energy, axis = torch.cat(energies), torch.cat(axes)
    loud = energy > FAINTEST * energy.max()
    return oriented_surface(
        places[loud].double().cpu().numpy(),
        energy[loud].double().cpu().numpy(),
        axis[loud].double().cpu().numpy(),
        lower,
        upper,
        step,
        level=level,
    )
