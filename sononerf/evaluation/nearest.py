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


def polydata(mesh: trimesh.Trimesh) -> Any:
    """Return a mesh as pyvista's PolyData."""
    import pyvista

    faces = np.asarray(mesh.faces)
    threes = np.full((len(faces), 1), 3, dtype=faces.dtype)
    return pyvista.PolyData(np.asarray(mesh.vertices), np.hstack([threes, faces]).ravel())


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
        from vtkmodules.vtkCommonDataModel import vtkCellLocator

        locator = vtkCellLocator()
        locator.SetDataSet(polydata(self.mesh))
        locator.SetNumberOfCellsPerNode(TRIANGLES_PER_BOX)
        locator.BuildLocator()
        return locator

    @cached_property
    def _signed(self) -> Any:
        from vtkmodules.vtkFiltersCore import vtkImplicitPolyDataDistance

        function = vtkImplicitPolyDataDistance()
        function.SetInput(polydata(self.mesh))
        return function

    def signed(self, points: Array) -> Array:
        """Return the distance of points (N, 3), (N,) m, negative inside."""
        if not len(points):
            return np.zeros(0)
        from vtkmodules.util.numpy_support import numpy_to_vtk, vtk_to_numpy
        from vtkmodules.vtkCommonCore import vtkDoubleArray

        given = np.ascontiguousarray(points, dtype=np.float64)
        found = vtkDoubleArray()
        self._signed.FunctionValue(numpy_to_vtk(given), found)
        return np.array(vtk_to_numpy(found), dtype=np.float64)

    def distance(self, points: Array) -> Array:
        """Return the distance of points (N, 3), (N,) m, zero or more; quicker than with a sign."""
        given = np.asarray(points, dtype=np.float64)
        if not len(given):
            return np.zeros(0)
        # No point of the surface that matters is farther than the nearest corner.
        bound, corner = self.corners.query(given)
        rank = np.zeros(self.corners.n, np.intp)
        rank[self.corners.indices] = np.arange(self.corners.n)
        found = self._within(given, bound, np.argsort(rank[corner], kind="stable"))
        lost = np.isinf(found)  # near corners of triangles without an area alone
        found[lost] = np.abs(self.signed(given[lost]))
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
