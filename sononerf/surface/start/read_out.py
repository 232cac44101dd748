# SPDX-License-Identifier: MIT
"""From a fitted field to a volume and a surface."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Literal

import numpy as np
import torch
import trimesh
from numpy.typing import NDArray
from scipy.ndimage import uniform_filter
from torch import Tensor

from sononerf.echoes.free_space import EchoHull
from sononerf.errors import NumericalError, SettingsError
from sononerf.field.field import Field
from sononerf.surface.openness import (
    Openness,
    judge_openness,
    known_part,
    leaving_out,
    without_unseen,
)
from sononerf.surface.start.isosurface import automatic_level, isosurface
from sononerf.surface.start.occupancy import QUIET, Gathered, estimate_occupancy, gather_evidence
from sononerf.surface.start.sheet import fit_sheet
from sononerf.surface.start.support import poses_that_heard
from sononerf.surface.start.volume import Volume, grid_over, volume_from_function

Array = NDArray[np.float64]
_FAINTEST = (
    1e-7  # fraction of the loudest place's energy; quieter places are left out, to save time
)
_CHUNK = 16_384  # places at a time, a bound of memory

Method = Literal["open", "filled", "hull", "sheet", "isosurface"]
"""How a surface is read out. The first three are the surface of the occupancy
(:mod:`sononerf.surface.start.occupancy`); ``sheet`` is one thin body
(:mod:`sononerf.surface.start.sheet`); ``isosurface`` is a level of the field's volume."""


@dataclass(frozen=True)
class Reconstruction:
    """What a field was read out to.

    Attributes
    ----------
    mesh : Trimesh
        The surface, m.
    volume : Volume
        The field's energy, or its loudness for an iso-surface.
    level : float or None
        Of the iso-surface, in the unit of the volume; None for other methods.
    method : {"open", "filled", "hull", "sheet", "isosurface"}
        How the surface was read out.
    openness : Openness or None
        What kind of surface it is; None for an iso-surface.
    gathered : Gathered or None
        The evidence that the occupancy was estimated from.
    support : (V,) int32 or None
        How many poses heard the surface around each vertex.
    """

    mesh: trimesh.Trimesh
    volume: Volume
    level: float | None
    method: Method
    openness: Openness | None = None
    gathered: Gathered | None = None
    support: NDArray[np.int32] | None = None


def reconstruct(
    field: Field,
    *,
    hull: EchoHull | None = None,
    spacing: float | None = None,
    level: float | Literal["auto"] = "auto",
    method: Method | Literal["auto"] = "auto",
    directions: int = 100,
    smoothing: float = 0.0,
    resolution: float | None = None,
    earlier: Reconstruction | None = None,
    judge: bool = True,
    progress: Callable[[int, int], None] | None = None,
) -> Reconstruction:
    """Read volume and surface out of a field.

    Parameters
    ----------
    field : Field
        What was fitted.
    hull : EchoHull or None
        The onsets and the poses that they were heard from. All methods but the iso-surface need
        it.
    spacing : float or None, m
        Voxel size; half of the field's own resolution where None.
    level : float or "auto"
        Value of the volume on the iso-surface; by Otsu's rule where "auto".
    method : {"auto", "open", "filled", "hull", "sheet", "isosurface"}
        ``auto`` is ``isosurface`` where a level or no hull is given, else ``filled``.
    directions : int
        Size of the spherical lattice that is summed over where the field has no lobes.
    smoothing : float, m
        Side of a box over which the volume is averaged before an iso-surface is drawn in it, an
        odd number of voxels; the published code of the paper takes 9 of 5 mm.
    resolution : float or None, m
        Range resolution of the analysis; 1.5 of the field's resolution where None.
    earlier : Reconstruction or None
        Of a call with the same field, hull, spacing and directions; its volume and evidence serve
        again, unless the method is ``isosurface``.
    judge : bool
        Whether :func:`judged` is applied.
    progress : callable, optional
        Called with the voxels done and the voxels in all.

    Returns
    -------
    reconstruction : Reconstruction

    Raises
    ------
    SettingsError
        If the spacing is larger than the region, a level is given to a method that has none, or
        there is no hull for a method that needs it.
    NumericalError
        If there is no surface: nothing was heard, the onsets contradict one another, the evidence
        does not lie on one sheet, or, for an iso-surface, the field is silent everywhere or nowhere
        at the level.
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
    chosen = _chosen(method, level, hull)
    values = _loudness(field, directions) if chosen == "isosurface" else _energy(field, directions)
    if chosen == "isosurface" or earlier is None:
        volume = volume_from_function(values, lower, upper, step, chunk=_CHUNK, progress=progress)
    else:
        volume = earlier.volume
    if chosen == "isosurface":
        return _isosurface(volume, level, smoothing)
    assert hull is not None
    gathered = None if earlier is None else earlier.gathered
    if gathered is None:
        wide = resolution or 1.5 * field.resolution
        places = _places(field, lower, upper, directions)
        gathered = gather_evidence(field, places, hull, lower, upper, step, wide)
    mesh = fit_sheet(gathered) if chosen == "sheet" else estimate_occupancy(gathered, chosen).mesh
    found = Reconstruction(mesh, volume, None, chosen, gathered=gathered)
    return judged(found) if judge else found


def judged(found: Reconstruction, support: NDArray[np.int32] | None = None) -> Reconstruction:
    """Return a reconstruction with its openness and support, without what no pose can have heard.

    An open surface also ends where what was heard of it ends.

    Parameters
    ----------
    found : Reconstruction
        Of any method; an iso-surface is returned as it is.
    support : (V,) int32, optional
        How many poses heard each vertex; counted in the evidence where None.
    """
    known = found.gathered
    if known is None:
        return found
    mesh = found.mesh
    if support is None:
        support = poses_that_heard(mesh, known.evidence, known.resolution)
    openness = judge_openness(mesh, known.hull.sources, resolution=known.resolution)
    if openness.kind == "one-sided":
        reliable = known.evidence.where(known.weight > QUIET)
        heard = poses_that_heard(mesh, reliable, known.resolution)
        part = known_part(mesh, heard, known.hull, resolution=known.resolution)
        part &= ~known.lattice.at_wall(mesh.triangles_center)
        if (part & ~openness.unseen).any():
            openness = leaving_out(openness, ~part, mesh.area_faces)
        used = np.unique(mesh.faces[~openness.unseen])
        mesh, support = without_unseen(mesh, openness), support[used]
    return replace(found, mesh=mesh, openness=openness, support=support)


def _chosen(
    method: Method | Literal["auto"], level: float | Literal["auto"], hull: EchoHull | None
) -> Method:
    if method == "auto":
        return "isosurface" if hull is None or level != "auto" else "filled"
    if method != "isosurface":
        if level != "auto":
            raise SettingsError(f"method {method} has no level; leave out one of the two")
        if hull is None:
            raise SettingsError(f"method {method}: it is not known where the field was heard from")
    return method


def _isosurface(volume: Volume, level: float | Literal["auto"], smoothing: float) -> Reconstruction:
    if not float(volume.values.max()) > 0:
        raise NumericalError("no surface: the field is silent everywhere")
    width = 2 * int(smoothing / volume.spacing / 2) + 1
    if width > 1:
        volume = volume.with_values(uniform_filter(volume.values, width, mode="nearest"))
    found = automatic_level(volume) if level == "auto" else level
    return Reconstruction(isosurface(volume, found), volume, found, "isosurface")


def energy_volume(field: Field, spacing: float, directions: int) -> Volume:
    """Return the energy of a field on a grid over its region.

    Parameters
    ----------
    field : Field
        What was fitted.
    spacing : float, m
        Voxel size.
    directions : int
        Size of the spherical lattice that is summed over where the field has no lobes.
    """
    lower, upper = (corner.double().cpu().numpy() for corner in field.region)
    return volume_from_function(_energy(field, directions), lower, upper, spacing, chunk=_CHUNK)


def _energy(field: Field, directions: int) -> Callable[[Array], Array]:
    return _inside(field, lambda places: field.oriented(places, directions)[0])


def _loudness(field: Field, directions: int) -> Callable[[Array], Array]:
    return _inside(field, lambda places: field.loudness(places, directions))


def _inside(field: Field, function: Callable[[Tensor], Tensor]) -> Callable[[Array], Array]:
    """Return a function of points that is zero where the field has no places."""

    def values_at(points: Array) -> Array:
        places = torch.as_tensor(points, dtype=field.region.dtype, device=field.region.device)
        inside = field.inside(places)
        values = places.new_zeros(len(places))
        if bool(inside.any()):
            values[inside] = function(places[inside])
        return np.asarray(values.cpu().numpy(), dtype=np.float64)

    return values_at


def _places(field: Field, lower: Array, upper: Array, directions: int) -> Tensor:
    """Return the field's own vertices that are not silent, (N, 3) m."""
    points = grid_over(lower, upper, field.resolution).points()
    # From the region's corner, where the field's own vertices lie.
    points = points - points[0] + lower
    places = torch.as_tensor(points, dtype=field.region.dtype, device=field.region.device)
    places = places[field.inside(places)]
    energy = torch.cat([field.oriented(part, directions)[0] for part in places.split(_CHUNK)])
    return places[energy > _FAINTEST * energy.amax()] if len(energy) else places
