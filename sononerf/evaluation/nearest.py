# SPDX-License-Identifier: MIT
"""How far places are from a surface: exact, and quick where many are asked about."""

from __future__ import annotations

from functools import cached_property
from typing import Any

import numpy as np
import trimesh
from numpy.typing import NDArray
from scipy.spatial import cKDTree

Array = NDArray[np.float64]
# Triangles per box of the locator; more are slower far from the surface, fewer near it.
TRIANGLES_PER_BOX = 8
# So much farther than a corner is looked, against rounding; of the distance and of the mesh's size.
SLACK = 1e-9


class Nearest:
    """Distances to one mesh, whose search structures are built once and when first needed.

    Parameters
    ----------
    mesh : Trimesh
        Any mesh with a triangle; it is not to be changed afterwards.
    """

    def __init__(self, mesh: trimesh.Trimesh) -> None:
        self.mesh = mesh

    @cached_property
    def corners(self) -> cKDTree:
        """The corners of the triangles."""
        return cKDTree(np.asarray(self.mesh.vertices)[np.unique(np.asarray(self.mesh.faces))])

    @cached_property
    def _locator(self) -> Any:
        import pyvista
        from vtkmodules.vtkCommonDataModel import vtkCellLocator

        vertices, faces = np.asarray(self.mesh.vertices), np.asarray(self.mesh.faces)
        locator = vtkCellLocator()
        locator.SetDataSet(pyvista.PolyData.from_regular_faces(vertices, faces))
        locator.SetNumberOfCellsPerNode(TRIANGLES_PER_BOX)
        locator.BuildLocator()
        return locator

    def distance(self, points: Array) -> Array:
        """Return the distance of points (N, 3), (N,) m, zero or more."""
        given = np.asarray(points, dtype=np.float64)
        if not len(given):
            return np.zeros(0)
        # No point of the surface that matters is farther than the nearest corner.
        bound, corner = self.corners.query(given)
        rank = np.zeros(self.corners.n, np.intp)
        rank[self.corners.indices] = np.arange(self.corners.n)
        found = self._within(given, bound, np.argsort(rank[corner], kind="stable"))
        # The nearest corner may be of triangles without an area, which the locator leaves out.
        lost = np.flatnonzero(np.isinf(found))
        far = bound[lost] + np.linalg.norm(np.ptp(self.corners.data, axis=0))
        found[lost] = self._within(given[lost], far, np.arange(len(lost)))
        return found

    def near(self, points: Array, limit: float) -> NDArray[np.bool_]:
        """Return whether points (N, 3) are no farther than a limit, in m; quicker still."""
        given = np.asarray(points, dtype=np.float64)
        close: NDArray[np.bool_] = self.corners.query(given, distance_upper_bound=limit)[0] <= limit
        rest = np.flatnonzero(~close)
        found = self._within(given[rest], np.full(len(rest), limit), np.arange(len(rest)))
        close[rest] = found <= limit
        return close

    def _within(self, points: Array, bound: Array, order: NDArray[np.intp]) -> Array:
        """Return distances up to a bound for each point, infinite where it is farther.

        Neighbours are asked about one after another, so that what one needs is still at hand.
        """
        from vtkmodules.vtkCommonCore import reference
        from vtkmodules.vtkCommonDataModel import vtkGenericCell

        place, cell = [0.0, 0.0, 0.0], vtkGenericCell()
        number, part, inside = (reference(0) for _ in range(3))
        squared: Any = reference(0.0)
        find = self._locator.FindClosestPointWithinRadius
        size = float(np.abs(self.corners.data).max())
        radii = (bound * (1 + SLACK) + SLACK * size).tolist()
        rows = points.tolist()
        found = np.full(len(points), np.inf)
        for index in order.tolist():
            if find(rows[index], radii[index], place, cell, number, part, squared, inside):
                found[index] = float(squared)
        return np.sqrt(found)
