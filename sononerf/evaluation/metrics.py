# SPDX-License-Identifier: MIT
"""Metrics of surfaces: exact distances to a solid, F-scores, parts."""

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
from sononerf.evaluation.prediction import prediction_metrics
from sononerf.geometry.raycast import contains
from sononerf.head.front_end import mae_db
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
        """Return the mask (N,) of the points (N, 3), m, inside the union."""
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
    """Draw points uniformly by area. Out: points ((count, 3), m), face (count,)."""
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
ROUNDING_SLACK = 1e-9


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
        """Return the mask (N,) of points (N, 3) within a distance, m; faster still."""
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
        radii = (bound * (1 + ROUNDING_SLACK) + ROUNDING_SLACK * size).tolist()
        rows = points.tolist()
        distances = np.full(len(points), np.inf)
        for index in order.tolist():
            if find(rows[index], radii[index], place, cell, number, part, squared, inside):
                distances[index] = float(squared)
        return np.sqrt(distances)


__all__ = ["geometry_metrics", "mae_db", "prediction_metrics", "target_metrics"]


def geometry_metrics(
    reconstructed: trimesh.Trimesh,
    truth: trimesh.Trimesh | Solid,
    *,
    samples: int = 100_000,
    seed: int = 0,
    thresholds: tuple[float, ...] = (0.001, 0.002, 0.005),
) -> dict[str, Any]:
    """Compare a reconstructed surface with the true one.

    The true surface is the outer surface of the solid union of the true bodies. Of the
    reconstruction all surface counts, a wall inside it too. Distances are exact, from area-uniform
    samples of the one surface to the triangles of the other.

    In: thresholds (tuple of float, m).
    """
    true = truth if isinstance(truth, Solid) else Solid(truth)
    solid = Solid(reconstructed, fill_cavities=False)
    true_points, true_normals = true.samples(samples, seed)
    points, face = sample_surface(reconstructed, samples, seed + 1)
    normals = np.asarray(reconstructed.face_normals)[face]
    to_truth = true.nearest.distance(points)
    to_mesh = Nearest(reconstructed).distance(true_points)
    return {
        "chamfer_m": float(to_truth.mean() + to_mesh.mean()) / 2,
        "fscore": {f"{limit:g}": _fscore(to_truth, to_mesh, limit) for limit in thresholds},
        "thickness_bias_m": _thickness_bias(true, points, to_truth),
        **_volume_metrics(solid, true),
        "normal_consistency": _normal_consistency(points, normals, true_points, true_normals),
        "components": solid.components,
        "components_true": true.components,
    }


def target_metrics(
    reconstructed: trimesh.Trimesh,
    target: trimesh.Trimesh,
    background: trimesh.Trimesh,
    *,
    samples: int = 100_000,
    seed: int = 0,
    thresholds: tuple[float, ...] = (0.001, 0.002, 0.005),
) -> dict[str, Any]:
    """Compare a reconstruction of a target amid surroundings with the target alone.

    Parts of the reconstruction count if they are nearer to the true target than to the true
    surroundings; else as :func:`geometry_metrics`.

    In: thresholds (tuple of float, m).
    """
    true = Solid(target)
    points, face = sample_surface(reconstructed, samples, seed + 1)
    around = Nearest(background)
    to_truth = true.nearest.distance(points)
    counts = to_truth <= around.distance(points)
    metrics: dict[str, Any] = {"share": float(counts.mean())}
    if not counts.any():
        return {**metrics, "chamfer_m": None, "fscore": {f"{limit:g}": 0.0 for limit in thresholds}}
    to_truth = to_truth[counts]
    # The border of the counted part is as coarse as the triangles.
    middles = np.asarray(reconstructed.triangles_center)
    kept = true.nearest.distance(middles) <= around.distance(middles)
    kept[face[counts]] = True
    part = trimesh.Trimesh(reconstructed.vertices, reconstructed.faces[kept], process=False)
    to_mesh = Nearest(part).distance(true.samples(samples, seed)[0])
    return {
        **metrics,
        "chamfer_m": float(to_truth.mean() + to_mesh.mean()) / 2,
        "fscore": {f"{limit:g}": _fscore(to_truth, to_mesh, limit) for limit in thresholds},
    }


def _fscore(to_truth: Floats, to_mesh: Floats, limit: float) -> float:
    precision, recall = (float((to_truth <= limit).mean()), float((to_mesh <= limit).mean()))
    return 2 * precision * recall / (precision + recall) if precision + recall else 0.0


def _thickness_bias(true: Solid, points: Floats, to_truth: Floats) -> float | None:
    if not true.closed:
        return None
    return float(np.where(true.contains(points), -to_truth, to_truth).mean())


def _volume_metrics(reconstructed: Solid, true: Solid) -> dict[str, float | None]:
    if not (reconstructed.closed and true.closed):
        return {"volume_ratio": None, "iou": None}
    shared = reconstructed.shared_volume(true)
    return {
        "volume_ratio": reconstructed.volume / true.volume,
        "iou": shared / (reconstructed.volume + true.volume - shared),
    }


def _normal_consistency(
    points: Floats, normals: Floats, true_points: Floats, true_normals: Floats
) -> float:
    there, back = _nearest_of(true_points, points), _nearest_of(points, true_points)
    forward = np.abs((normals * true_normals[there]).sum(axis=1)).mean()
    backward = np.abs((true_normals * normals[back]).sum(axis=1)).mean()
    return float(forward + backward) / 2


def _nearest_of(points: Floats, places: Floats) -> NDArray[np.intp]:
    """Return the index (N,) of the point that is nearest to each place."""
    # Neighbours follow one another, so that their part of the tree is still in the cache.
    cells = ((places - places.min(axis=0)) / max(float(np.ptp(places)), 1e-12) * 64).astype(np.intp)
    order = np.lexsort(cells.T)
    found = np.zeros(len(places), np.intp)
    found[order] = cKDTree(points).query(places[order])[1]
    return found
