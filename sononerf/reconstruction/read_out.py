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
from scipy.ndimage import uniform_filter
from scipy.spatial import cKDTree
from torch import Tensor

from sononerf.echoes.free_space import EchoHull
from sononerf.errors import NumericalError, SettingsError
from sononerf.field.field import Field
from sononerf.geometry.raycast import RayCaster
from sononerf.reconstruction.glints import Glints, find_glints, trust
from sononerf.reconstruction.isosurface import automatic_level, isosurface
from sononerf.reconstruction.openness import (
    THIN,
    Openness,
    judge_openness,
    without_unseen,
)
from sononerf.reconstruction.oriented import oriented_surface
from sononerf.reconstruction.outline import clearance_volume, outline
from sononerf.reconstruction.volume import Volume, grid_over, volume_from_function
from sononerf.surface.occupancy import Gathered, estimate_occupancy, gather_evidence

Array = NDArray[np.float64]
FAINTEST = 1e-7
"""Places this far below the loudest take no part in the oriented surface."""
CHUNK = 16_384
SMOOTHING = 1.75
"""Of the surface through glints, voxels."""
CLEARANCE = 0.008
"""How far in front of a glint its line of sight has to be free, m."""
HIDDEN = 0.02
"""What a glint still weighs that its pose cannot see: a second bounce."""
LOOKS = 1
"""How often the surface is drawn anew without those."""
AHEAD = 0.002
"""Glints so far in front of a pose's first echo are none, m."""
INFLATED = 1.0
"""By so much a sheet is drawn too thick at first, voxels to each side."""
BACKED = 0.5
"""More than this part of a sheet's points have some of the other side within its thickness."""
BACK_TO_BACK = -0.7
"""Cosine between the normals of the two sides of a sheet, at most."""
OUTLINE = 0.5
"""What all points of the outline weigh, beside the glints."""


Method = Literal["open", "filled", "oriented", "hull", "isosurface"]


@dataclass(frozen=True)
class Reconstruction:
    """What a field was read out to; glints and openness where it was heard from known poses."""

    mesh: trimesh.Trimesh
    volume: Volume
    level: float
    method: Method
    glints: Glints | None = None
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
    gathered: Gathered | None = None,
    progress: Callable[[int, int], None] | None = None,
) -> Reconstruction:
    """Read volume and surface out of a field.

    Parameters
    ----------
    field : Field
        What was fitted.
    hull : EchoHull or None
        Where it was fitted to be heard from, and what the first echoes leave. With it the oriented
        surface runs where the field sounds from and, where that is silent, along the hull;
        without, where the field's places lie, which is a millimetre less exact.
    spacing : float or None, m
        Voxel size; half of the field's own resolution where None.
    level : float or "auto"
        Value of the volume, or of the oriented indicator, on the surface; of the hull the depth, m.
    method : {"auto", "open", "filled", "oriented", "hull", "isosurface"}
        ``auto`` is the oriented surface where the field knows directions, or the hull where it was
        heard from. ``hull`` is what the first echoes leave, whatever the field says: exact for a
        body without hollows. ``open`` and ``filled`` are the surface of the occupancy, see
        :mod:`sononerf.surface.occupancy`, with hollows opened by the winding number or not; both
        need a hull and the resolution.
    directions : int
        Size of the spherical lattice that is summed over where the field has no lobes.
    smoothing : float, m
        Side of a box over which the volume is averaged before an iso-surface is drawn in it, an
        odd number of voxels; the published code of the paper takes 9 of 5 mm.
    resolution : float or None, m
        Range resolution of the analysis.
    gathered : Gathered or None
        The evidence of an earlier call with the same field, hull and spacing.
    progress : callable, optional
        Called with the voxels done and the voxels in all.

    Returns
    -------
    reconstruction : Reconstruction

    Raises
    ------
    SettingsError
        If the spacing is larger than the region, or ``hull`` is asked for without one.
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
        heard = field.knows_directions or hull is not None
        method = "oriented" if heard else "isosurface"
    if method in ("hull", "open", "filled") and hull is None:
        raise SettingsError(f"method {method}: it is not known where the field was heard from")
    volume = volume_from_function(
        _loudness(field, directions, method), lower, upper, step, chunk=CHUNK, progress=progress
    )
    if not float(volume.values.max()) > 0:
        raise NumericalError("no surface: the field is silent everywhere")
    if method != "isosurface":
        places, energy, axis = _places(field, lower, upper, directions)
        if method in ("open", "filled"):
            assert hull is not None
            if gathered is None:
                wide = resolution or 1.5 * field.resolution
                gathered = gather_evidence(field, places, hull, lower, upper, step, wide)
            body = estimate_occupancy(gathered, opening=method == "open")
            openness = judge_openness(body.mesh, hull.sources)
            mesh = body.mesh
            support: NDArray[np.int32] | None = body.support
            if openness.kind == "one-sided":
                mesh, support = without_unseen(mesh, openness), None
            return Reconstruction(mesh, volume, 0.0, method, None, openness, gathered, support)
        if hull is not None:
            sources = torch.as_tensor(hull.sources, dtype=places.dtype, device=places.device)
            glints = find_glints(field, places, sources)
            if method == "hull":
                found = 0.0 if level == "auto" else level
                mesh = isosurface(clearance_volume(hull, lower, upper, step), found)
            else:
                mesh, _, found = _glint_surface(glints, hull, lower, upper, step, level)
            openness = judge_openness(mesh, hull.sources)
            if openness.kind == "one-sided":
                mesh = without_unseen(mesh, openness)
            return Reconstruction(mesh, volume, found, method, glints, openness)
        mesh, _, found = oriented_surface(
            *(_numbers(places), _numbers(energy), _numbers(axis)),
            *(lower, upper, step),
            level=level,
        )
        return Reconstruction(mesh, volume, found, method)
    width = 2 * int(smoothing / step / 2) + 1
    if width > 1:
        volume = volume.with_values(uniform_filter(volume.values, width, mode="nearest"))
    found = automatic_level(volume) if level == "auto" else level
    return Reconstruction(isosurface(volume, found), volume, found, method)


def _numbers(values: Tensor) -> Array:
    return np.asarray(values.double().cpu().numpy())


def _loudness(field: Field, directions: int, method: Method) -> Callable[[Array], Array]:
    def loudness(points: Array) -> Array:
        places = torch.as_tensor(points, dtype=field.region.dtype, device=field.region.device)
        inside = field.inside(places)
        values = places.new_zeros(len(places))
        if bool(inside.any()):
            if method != "isosurface":
                values[inside] = field.oriented(places[inside], directions)[0]
            else:
                values[inside] = field.loudness(places[inside], directions)
        return np.asarray(values.cpu().numpy(), dtype=np.float64)

    return loudness


def _places(
    field: Field, lower: Array, upper: Array, directions: int
) -> tuple[Tensor, Tensor, Tensor]:
    """Return the field's own vertices that are not silent, with energies and axes."""
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
    return places[loud], energy[loud], axis[loud]


def _glint_surface(
    glints: Glints,
    hull: EchoHull,
    lower: Array,
    upper: Array,
    step: float,
    level: float | Literal["auto"],
) -> tuple[trimesh.Trimesh, Volume, float]:
    """Draw the surface through the glints that their poses can see, and along the hull."""
    glints = glints.where(hull.clearance(glints.points)[0] >= -AHEAD)
    trusted = trust(glints)
    weights = glints.power * trusted
    clearance = clearance_volume(hull, lower, upper, step)
    points, normals = outline(hull, clearance, glints, trusted)
    total = weights.sum() or 1.0
    silent = np.full(len(points), OUTLINE * total / max(len(points), 1))
    where = np.concatenate((glints.points, points))
    normals = np.concatenate((glints.normals, normals))

    def draw(inflated: float) -> tuple[trimesh.Trimesh, Volume, float]:
        seen = np.ones(len(weights), dtype=bool)
        for look in range(LOOKS + 1):
            mesh, indicator, used = oriented_surface(
                where + inflated * normals,
                np.concatenate((weights * np.where(seen, 1.0, HIDDEN), silent)),
                normals,
                *(lower, upper, step),
                smoothing=SMOOTHING,
                level=level,
                bound=np.asarray(clearance.values + inflated, dtype=np.float64),
            )
            if inflated:
                mesh.vertices = mesh.vertices - inflated * mesh.vertex_normals
            if look == LOOKS:
                break
            before = seen
            seen = RayCaster(mesh).visible(
                glints.points + CLEARANCE * glints.normals, hull.sources[glints.pose]
            )
            if (seen == before).all():
                break
        return mesh, indicator, used

    # The two sides of a sheet would cancel: drawn on a thicker one, which is then thinned again.
    if not _is_sheet(where, normals):
        try:
            return draw(0.0)
        except NumericalError:
            pass  # they have cancelled: a sheet, though too little was heard of it to be sure
    return draw(INFLATED * step)


def _is_sheet(points: Array, normals: Array) -> bool:
    """Return whether most points have others right behind them that face the other way."""
    pairs = cKDTree(points).query_pairs(THIN, output_type="ndarray")
    opposite = (normals[pairs[:, 0]] * normals[pairs[:, 1]]).sum(axis=1) < BACK_TO_BACK
    backed = np.unique(pairs[opposite])
    return len(backed) > BACKED * len(points)
