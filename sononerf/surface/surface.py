# SPDX-License-Identifier: MIT
"""A reconstructed surface: its mesh, what is known about it, and where it ends."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import trimesh
from numpy.typing import NDArray

from sononerf.surface.openness import (
    Openness,
    judge_openness,
    known_part,
    leaving_out,
    without_unseen,
)
from sononerf.surface.start.occupancy import QUIET
from sononerf.surface.start.read_out import FieldReading, Method
from sononerf.surface.start.reliability import poses_that_heard
from sononerf.surface.start.volume import Volume


@dataclass(frozen=True, eq=False)
class Surface:
    """A reconstructed surface.

    Attributes
    ----------
    mesh : Trimesh
        World frame, m.
    volume : Volume
        The field's energy, or its loudness for an iso-surface.
    method : {"open", "filled", "hull", "sheet", "isosurface"}
        How the surface was found, or the start that was refined.
    level : float or None
        Of an iso-surface, in the unit of the volume; None for other methods.
    openness : Openness or None
        What kind of surface it is; None for an iso-surface.
    support : (V,) int32 or None
        How many poses heard the surface around each vertex.
    refined : bool
        True where the refined mesh explains the validation poses better than its start.
    error_db : float or None, dB
        Objective of the refinement on validation poses; None without a refinement.
    """

    mesh: trimesh.Trimesh
    volume: Volume
    method: Method
    level: float | None = None
    openness: Openness | None = None
    support: NDArray[np.int32] | None = None
    refined: bool = False
    error_db: float | None = None


def finished_surface(
    mesh: trimesh.Trimesh,
    method: Method,
    reading: FieldReading,
    *,
    support: NDArray[np.int32] | None = None,
    refined: bool = False,
    error_db: float | None = None,
) -> Surface:
    """Return the surface of a closed mesh, without the triangles that no pose can have heard.

    An open surface also ends where the evidence for it ends.

    Parameters
    ----------
    mesh : Trimesh
        A start surface or a refined one, m.
    method : {"open", "filled", "hull", "sheet"}
        How its start was found.
    reading : FieldReading
        Evidence that the start was made of.
    support : (V,) int32, optional
        How many poses heard each vertex; counted in the evidence where None.
    refined, error_db
        As of :class:`Surface`.
    """
    known = reading.gathered
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
    return Surface(
        mesh,
        reading.volume,
        method,
        openness=openness,
        support=support,
        refined=refined,
        error_db=error_db,
    )
