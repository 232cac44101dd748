# SPDX-License-Identifier: MIT
"""Distances to surfaces; a mesh as the solid union of its closed bodies, beside its open sheets."""

from __future__ import annotations

from functools import cached_property
from typing import Any

import manifold3d
import numpy as np
import trimesh
from manifold3d import Manifold, OpType
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from sononerf.errors import NumericalError
from sononerf.geometry.raycast import contains
from sononerf.numerics import Bools, Floats

Samples = tuple[Floats, Floats]

SMALLEST_PART = 0.01
"""Parts with less than this fraction of the largest part's area are not counted."""
ROUNDING = 1e-9
"""Largest volume, as a fraction of a body's own, that counts as zero: it comes from rounding."""


class Solid:
    """The union of the closed bodies of a mesh, and its open sheets.

    Attributes:
        union: The solid; empty if no part is closed.
        sheets: The parts that are open or enclose no volume.
    """

    def __init__(self, mesh: trimesh.Trimesh, *, fill_cavities: bool = True) -> None:
        bodies: list[Manifold] = []
        cavities: list[Manifold] = []
        self.sheets: list[trimesh.Trimesh] = []
        for part in split_parts(_merged(mesh)):
            solid = _manifold(part)
            if solid is None:
                self.sheets.append(part)
            elif solid.volume() > 0:
                bodies.append(solid)
            else:
                part.invert()
                cavities.append(_manifold(part) or Manifold())
        hollow = list(bodies)
        for cavity in cavities:
            # A cavity belongs to the smallest body around it; without one it is a body inside out.
            limit = ROUNDING * cavity.volume()
            around = [
                index for index, body in enumerate(bodies) if (cavity - body).volume() < limit
            ]
            if around:
                smallest = min(around, key=lambda index: bodies[index].volume())
                hollow[smallest] -= cavity
            else:
                bodies.append(cavity)
                hollow.append(cavity)
        self.union = _union(hollow)
        if fill_cavities:
            shells = [shell for shell in _union(bodies).decompose() if shell.volume() > 0]
            self.union = _union(shells)
        self._samples: dict[tuple[int, int], Samples] = {}

    @property
    def closed(self) -> bool:
        """Whether every part is closed, so that there is an inside."""
        return not self.union.is_empty() and not self.sheets

    @property
    def volume(self) -> float:
        """Volume of the union, m³."""
        return float(self.union.volume())

    def shared_volume(self, other: Solid) -> float:
        """Return the volume of the intersection with another solid, m³."""
        return float((self.union ^ other.union).volume())

    @cached_property
    def components(self) -> int:
        """Number of connected parts; overlapping bodies are one part.

        A sheet is a part of its own. Parts below ``SMALLEST_PART`` are not counted.
        """
        shells = (shell for shell in self.union.decompose() if shell.volume() > 0)
        areas = [*(shell.surface_area() for shell in shells), *(s.area for s in self.sheets)]
        return int((np.array(areas) > SMALLEST_PART * max(areas)).sum())

    def contains(self, points: Floats) -> Bools:
        """Return whether points (N, 3), in m, lie inside the union, (N,)."""
        if self.union.is_empty():
            return np.zeros(len(points), bool)
        mesh = _trimesh(self.union)
        return contains(mesh.vertices, mesh.faces, points)

    @cached_property
    def surface(self) -> trimesh.Trimesh:
        """The surface of the union, and the triangles of sheets with a centroid outside it."""
        kept = [] if self.union.is_empty() else [_trimesh(self.union)]
        for sheet in self.sheets:
            outside = np.flatnonzero(~self.contains(np.asarray(sheet.triangles_center)))
            if len(outside):
                kept.append(sheet.submesh([outside], append=True, repair=False))
        return trimesh.util.concatenate(kept)

    @cached_property
    def nearest(self) -> Nearest:
        """Distances to the surface."""
        return Nearest(self.surface)

    def samples(self, count: int, seed: int) -> Samples:
        """Return points (count, 3) in m, uniform by area, and normals; drawn once per seed."""
        key = count, seed
        if key not in self._samples:
            points, face = sample_surface(self.surface, count, seed)
            self._samples[key] = points, np.asarray(self.surface.face_normals)[face]
        return self._samples[key]


def sample_surface(mesh: trimesh.Trimesh, count: int, seed: int) -> tuple[Floats, NDArray[np.intp]]:
    """Draw points uniformly by area.

    Out: points ((count, 3), m), face (count,).
    """
    if not mesh.area > 0:
        raise NumericalError("the mesh has no area to draw points from")
    points, face = trimesh.sample.sample_surface(mesh, count, seed=seed)
    return np.asarray(points), np.asarray(face)


def split_parts(mesh: trimesh.Trimesh) -> list[trimesh.Trimesh]:
    """Return the parts that share no edge, the one of the largest area first."""
    parts = mesh.split(only_watertight=False, repair=False) if len(mesh.faces) else []
    return sorted(parts, key=lambda part: -part.area)


def _merged(mesh: trimesh.Trimesh) -> trimesh.Trimesh:
    if not len(mesh.faces):
        raise NumericalError("the mesh is empty: it has no triangle")
    if not np.isfinite(mesh.vertices).all():
        raise NumericalError("the mesh has vertices that are not finite")
    if mesh.is_watertight:
        return mesh
    # STL and other formats store each triangle's corners apart.
    merged = trimesh.Trimesh(mesh.vertices, mesh.faces, process=True, validate=False)
    a, b, c = np.asarray(merged.faces).T
    merged.update_faces((a != b) & (b != c) & (c != a))
    if not len(merged.faces):
        raise NumericalError("the mesh has no triangle with an area")
    return merged


def _union(solids: list[Manifold]) -> Manifold:
    return Manifold.batch_boolean(solids, OpType.Add) if solids else Manifold()


def _manifold(part: trimesh.Trimesh) -> Manifold | None:
    """Return a part as a solid; None if it is open or encloses no volume."""
    if not part.is_watertight:
        return None
    if not part.is_winding_consistent:
        trimesh.repair.fix_winding(part)
    vertices, faces = np.asarray(part.vertices, np.float64), np.asarray(part.faces, np.uint64)
    solid = Manifold(manifold3d.Mesh64(vertices, faces))
    return solid if abs(solid.volume()) > 0 else None


def _trimesh(solid: Manifold) -> trimesh.Trimesh:
    mesh = solid.to_mesh64()
    vertices, faces = mesh.vert_properties[:, :3], mesh.tri_verts.astype(np.int64)
    return trimesh.Trimesh(vertices, faces, process=False, validate=False)


# Triangles per box of the locator; more are slower far from the surface, fewer near it.
TRIANGLES_PER_BOX = 8
# So much farther than a corner is looked, against rounding; of the distance and of the mesh's size.
SLACK = 1e-9


class Nearest:
    """Distances to one mesh, whose search structures are built once and when first needed."""

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

    def distance(self, points: Floats) -> Floats:
        """Return the distance of points (N, 3), (N,) m, zero or more."""
        given = np.asarray(points, dtype=np.float64)
        if not len(given):
            return np.zeros(0)
        # No point of the surface that matters is farther than the nearest corner.
        bound, corner = self.corners.query(given)
        rank = np.zeros(self.corners.n, np.intp)
        rank[self.corners.indices] = np.arange(self.corners.n)
        distances = self._within(given, bound, np.argsort(rank[corner], kind="stable"))
        # The nearest corner may be of triangles without an area, which the locator leaves out.
        lost = np.flatnonzero(np.isinf(distances))
        far = bound[lost] + np.linalg.norm(np.ptp(self.corners.data, axis=0))
        distances[lost] = self._within(given[lost], far, np.arange(len(lost)))
        return distances

    def near(self, points: Floats, limit: float) -> Bools:
        """Return whether points (N, 3) are no farther than a limit, in m; quicker still."""
        given = np.asarray(points, dtype=np.float64)
        close: Bools = self.corners.query(given, distance_upper_bound=limit)[0] <= limit
        rest = np.flatnonzero(~close)
        found = self._within(given[rest], np.full(len(rest), limit), np.arange(len(rest)))
        close[rest] = found <= limit
        return close

    def _within(self, points: Floats, bound: Floats, order: NDArray[np.intp]) -> Floats:
        """Return distances up to a bound for each point, infinite where it is farther.

        Neighbours follow one another, so that their data are still in the cache.
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
        distances = np.full(len(points), np.inf)
        for index in order.tolist():
            if find(rows[index], radii[index], place, cell, number, part, squared, inside):
                distances[index] = float(squared)
        return np.sqrt(distances)
