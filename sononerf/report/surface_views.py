# SPDX-License-Identifier: MIT
"""A surface beside the truth, coloured by its distance from it and by its error."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np
import trimesh
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from sononerf.evaluation.geometry import signed_error
from sononerf.numerics import Floats
from sononerf.report.pictures.mesh_picture import (
    CLAY,
    STEEL,
    UNHEARD,
    ColourScale,
    confidence_scale,
    distance_scale,
    error_scale,
    sides_png,
)
from sononerf.surface.mesh_files import linear_light

MOST_TRIANGLES = 60_000
"""Largest number of triangles of a mesh in a page: three such meshes take about 6 MB of the 15 MB
that a page may have. Larger meshes are decimated."""


@dataclass(frozen=True, eq=False)
class SurfaceViews:
    """Pictures and coloured meshes of a surface.

    In: confidence ((V,) int32 or None), error ((V,) float32 or None, m), limit (m).
    """

    mesh: trimesh.Trimesh
    confidence: NDArray[np.int32] | None
    error: NDArray[np.float32] | None
    truth: trimesh.Trimesh | None
    limit: float

    @cached_property
    def _rows(self) -> list[tuple[str, trimesh.Trimesh, Floats, ColourScale | None]]:
        rows: list[tuple[str, trimesh.Trimesh, Floats, ColourScale | None]] = []
        if self.truth is not None:
            scale = distance_scale(self.limit)
            off = scale(1e3 * signed_error(self.mesh, self.truth))
            rows.append(("truth", self.truth, np.array(STEEL), None))
            rows.append(("distance", self.mesh, off, scale))
        if self.error is not None:
            scale = error_scale(self.limit)
            colours = scale(1e3 * self.error)
            if self.confidence is not None:
                colours[self.confidence == 0] = UNHEARD
            rows.append(("error", self.mesh, colours, scale))
        elif self.confidence is not None:
            scale = confidence_scale()
            rows.append(("confidence", self.mesh, scale(self.confidence), scale))
        return rows or [("reconstruction", self.mesh, np.array(CLAY), None)]

    def png(self, size: tuple[int, int] = (380, 340)) -> bytes:
        """Draw truth, distance and error from four sides, one row each; ``size`` is of a view."""
        return sides_png(self._rows, size=size)

    def meshes(self) -> dict[str, trimesh.Trimesh]:
        """Return coloured meshes by name, the reconstruction first; of glTF's linear colours."""
        names = {
            "distance": "reconstruction, coloured by its distance from the truth",
            "error": "reconstruction, coloured by its error, known without the truth",
            "confidence": "reconstruction, coloured by how many poses heard it",
        }
        rows = self._rows
        ordered = [row for row in rows if row[0] != "truth"]
        ordered += [row for row in rows if row[0] == "truth"]
        return {names.get(name, name): _coloured(mesh, c) for name, mesh, c, _ in ordered}


def _coloured(mesh: trimesh.Trimesh, colours: Floats) -> trimesh.Trimesh:
    small = decimated(mesh, MOST_TRIANGLES)
    if colours.ndim == 2:
        colours = colours[cKDTree(mesh.vertices).query(small.vertices)[1]]
    light = np.broadcast_to(linear_light(colours), (len(small.vertices), 3))
    small.visual = trimesh.visual.ColorVisuals(
        small, vertex_colors=np.round(255 * light).astype(np.uint8)
    )
    return small


def decimated(mesh: trimesh.Trimesh, triangles: int) -> trimesh.Trimesh:
    """Return a copy of a mesh, without colours, with at most about this number of triangles."""
    if len(mesh.faces) > triangles:
        import pyvista

        reduced = pyvista.wrap(mesh).decimate(1.0 - triangles / len(mesh.faces))
        return trimesh.Trimesh(reduced.points, reduced.regular_faces, process=False)
    return trimesh.Trimesh(mesh.vertices.copy(), mesh.faces.copy(), process=False, validate=False)
