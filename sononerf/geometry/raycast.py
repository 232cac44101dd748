# SPDX-License-Identifier: MIT
"""Ray casting against a triangle mesh: first hits, visibility, and points inside."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any, Protocol, TypeAlias

import numpy as np
import trimesh

from sononerf.geometry.meshes import corner_normals, total_curvature, weight_gradients
from sononerf.numerics import Bools, Floats, Ints, Singles, compiled

try:
    from embreex.mesh_construction import TriangleMesh
    from embreex.rtcore_scene import EmbreeScene
except ImportError:  # no wheels for Linux on ARM nor Windows on ARM
    EmbreeScene = None

from numpy.typing import ArrayLike

# Of the mesh's size. Single precision puts a point up to 1e-7 sizes off its triangle, on either
# side; without a lift half of all reflected rays hit the triangle they start from.
LIFT = 4e-6
Reals: TypeAlias = Floats | Singles


@dataclass(frozen=True, eq=False)
class Hits:
    """First hits of rays, one row per ray that hits anything."""

    ray: Ints  # (H,): Index of the ray, ascending
    points: Floats  # (H, 3), m: On the triangle
    normals: Floats  # (H, 3): Smooth unit normals, as the mesh is oriented
    triangle: Ints  # (H,): Index of the triangle
    distance: Floats  # (H,), m: Along the ray
    flat: Floats  # (H, 3): Unit normals of the flat triangles
    # (H, 4, 3) float32: Changes of the smooth normal along the triangle: gradients of the second
    # and third corner's weight (1/m), and by how much the normals there differ from that at the
    # first
    gradients: Singles


class _Engine(Protocol):
    """Search structure over triangles, in coordinates of about unit size."""

    def first(self, origins: Floats, directions: Floats) -> Ints: ...

    def blocked(self, origins: Reals, spans: Reals) -> Bools: ...


class _EmbreeEngine:
    """Embree: millions of rays a second, single precision, processes only (it holds the GIL)."""

    def __init__(self, vertices: Floats, faces: Ints) -> None:
        self._scene = EmbreeScene()
        TriangleMesh(self._scene, vertices.astype(np.float32), faces.astype(np.int32))

    def first(self, origins: Floats, directions: Floats) -> Ints:
        found = self._scene.run(
            origins.astype(np.float32), directions.astype(np.float32), query="INTERSECT"
        )
        return np.asarray(found, dtype=np.int64)

    def blocked(self, origins: Reals, spans: Reals) -> Bools:
        # Distances count in lengths of the direction, so 1 is the target. Asked for more output
        # than this, the occlusion query returns uninitialised memory.
        hits = self._scene.run(
            origins.astype(np.float32, copy=False),
            spans.astype(np.float32, copy=False),
            dists=np.ones(len(origins), np.float32),
            query="OCCLUDED",
        )
        return np.asarray(hits) == 0


class _VtkEngine:
    """VTK's cell locator: everywhere, and some thirty times slower."""

    def __init__(self, vertices: Floats, faces: Ints) -> None:
        import pyvista as pv
        from vtkmodules.vtkCommonDataModel import vtkStaticCellLocator

        self._locator = vtkStaticCellLocator()
        self._locator.SetDataSet(pv.PolyData.from_regular_faces(vertices, faces))
        self._locator.BuildLocator()
        self._reach = 2.0 * float(np.linalg.norm(vertices, axis=1).max())

    def _search(self, start: Any, end: Any) -> int:
        from vtkmodules.vtkCommonCore import reference
        from vtkmodules.vtkCommonDataModel import vtkGenericCell

        # VTK writes into these; its stubs call them plain numbers.
        cell: Any = reference(-1)
        position: Any = reference(0.0)
        part: Any = reference(0)
        place, within = [0.0] * 3, [0.0] * 3
        found = self._locator.IntersectWithLine(
            start, end, 0.0, position, place, within, part, cell, vtkGenericCell()
        )
        return int(cell) if found else -1

    def first(self, origins: Floats, directions: Floats) -> Ints:
        length = self._reach + np.linalg.norm(origins, axis=1, keepdims=True)
        ends = origins + length * directions
        return np.array([self._search(a, b) for a, b in zip(origins, ends, strict=True)], np.int64)

    def blocked(self, origins: Reals, spans: Reals) -> Bools:
        ends = origins + spans
        return np.array([self._search(a, b) >= 0 for a, b in zip(origins, ends, strict=True)], bool)


@compiled
def _hits_of(
    triangles: Ints,
    origins: Floats,
    directions: Floats,
    planes: Floats,
    smooth: Singles,
    corners: Floats,
) -> tuple[Ints, Floats, Floats, Ints, Floats, Floats, Singles]:
    """Return the attributes of :class:`Hits`.

    In: triangles (N,), origins ((N, 3) or (1, 3), m), directions (N, 3), planes (T, 6), smooth
    ((T, 5, 3) float32), corners ((T, 3, 3), m).
    """
    ray, count = np.zeros(len(triangles), np.int64), 0
    for i in range(len(triangles)):
        if triangles[i] >= 0:
            ray[count] = i
            count += 1
    ray = ray[:count].copy()
    triangle, distance = np.zeros(count, np.int64), np.zeros(count)
    points, normals, flat = np.zeros((count, 3)), np.zeros((count, 3)), np.zeros((count, 3))
    gradients = np.zeros((count, 4, 3), np.float32)
    weight = np.zeros(3)
    for i in range(count):
        at = triangles[ray[i]]
        start = origins[ray[i] if len(origins) > 1 else 0]
        along, plane, of = directions[ray[i]], planes[at], smooth[at]
        slope = along[0] * plane[3] + along[1] * plane[4] + along[2] * plane[5]
        height = 0.0
        for k in range(3):
            height += (plane[k] - start[k]) * plane[3 + k]
        # A ray along the plane meets it nowhere; it is then moved onto the triangle below.
        far = height / slope if abs(slope) > 1e-12 else 0.0
        weight[1], weight[2] = 0.0, 0.0
        for k in range(3):
            points[i, k] = start[k] + far * along[k]
            offset = points[i, k] - plane[k]
            weight[1] += of[0, k] * offset
            weight[2] += of[1, k] * offset
        weight[0] = 1.0 - weight[1] - weight[2]
        if min(weight[0], weight[1], weight[2]) < -1e-4:
            total = 0.0
            for k in range(3):
                weight[k] = max(weight[k], 0.0)
                total += weight[k]
            far = 0.0
            for k in range(3):
                weight[k] /= total
            for k in range(3):
                points[i, k] = 0.0
                for corner in range(3):
                    points[i, k] += weight[corner] * corners[at, corner, k]
                far += (points[i, k] - start[k]) * along[k]
        length = 0.0
        for k in range(3):
            normals[i, k] = of[4, k] + weight[1] * of[2, k] + weight[2] * of[3, k]
            length += normals[i, k] * normals[i, k]
        length = math.sqrt(length) if length > 0.0 else 1.0
        for k in range(3):
            normals[i, k] /= length
            flat[i, k] = plane[3 + k]
            for row in range(4):
                gradients[i, row, k] = of[row, k]
        triangle[i], distance[i] = at, far
    return ray, points, normals, triangle, distance, flat, gradients


@compiled
def _sight(
    points: Floats, normals: Floats, targets: Floats, middle: Floats, scale: float, lift: float
) -> tuple[Singles, Singles]:
    """Return origins and spans (N, 3), in the engine's coordinates, from lifted points to targets.

    In: points, normals ((N, 3), m), targets ((N, 3) or (1, 3), m), middle ((3,), m), scale (1/m),
    lift (m).
    """
    origins = np.zeros((len(points), 3), np.float32)
    spans = np.zeros((len(points), 3), np.float32)
    for i in range(len(points)):
        target = targets[i if len(targets) > 1 else 0]
        by = lift
        if len(normals) == 0:
            length = 0.0
            for k in range(3):
                length += (target[k] - points[i, k]) ** 2
            by = lift / math.sqrt(length) if length > 0.0 else 0.0
        for k in range(3):
            direction = target[k] - points[i, k] if len(normals) == 0 else normals[i, k]
            lifted = points[i, k] + by * direction
            origins[i, k] = (lifted - middle[k]) * scale
            spans[i, k] = (target[k] - lifted) * scale
    return origins, spans


class RayCaster:
    """Rays against one mesh. It cannot be pickled; send the mesh instead.

    Attributes:
        face_normals (T, 3): Unit normals of the flat triangles; of one without area, zero.
        curvature ((T,), 1/m): Total curvature of the smooth surface.
        lift (m): Height above its triangle at which a ray starts from a hit.
    """

    def __init__(self, mesh: trimesh.Trimesh) -> None:
        lower, upper = np.asarray(mesh.bounds)
        self._middle = (lower + upper) / 2.0
        self._size = float(np.linalg.norm(upper - lower))
        self.lift = LIFT * self._size
        faces = np.asarray(mesh.faces, dtype=np.int64)
        vertices = np.asarray(mesh.vertices, dtype=np.float64)
        self._corners = vertices[faces]  # (T, 3, 3)
        ab = self._corners[:, 1] - self._corners[:, 0]
        ac = self._corners[:, 2] - self._corners[:, 0]
        sides = np.cross(ab, ac)
        area = np.linalg.norm(sides, axis=1, keepdims=True)
        solid = np.where(area > 0.0, area, np.inf)
        self.face_normals = sides / solid
        smooth = corner_normals(mesh)  # (T, 3, 3)
        self.curvature = total_curvature(mesh, smooth)
        second, third = weight_gradients(self._corners)
        # Side by side, so that a hit reads one stretch of memory.
        self._planes = np.concatenate([self._corners[:, 0], self.face_normals], axis=1)
        differs = smooth[:, 1:] - smooth[:, :1]
        self._gradients = (
            np.concatenate([second, third, differs[:, 0], differs[:, 1], smooth[:, 0]], axis=1)
            .astype(np.float32)
            .reshape(-1, 5, 3)
        )
        # Single precision counts from the origin: far from it, millimetres would be lost.
        scaled = (vertices - self._middle) / self._size
        self._engine: _Engine = (
            _VtkEngine(scaled, faces) if EmbreeScene is None else _EmbreeEngine(scaled, faces)
        )

    def first_hit(self, origins: Floats, directions: Floats) -> Hits:
        """Return the first hit of each ray; rays without a hit are left out.

        In: origins ((N, 3), m), directions (N, 3).
        """
        hits = self._engine.first(self._scaled(origins), directions)
        one = len(origins) > 1 and origins.strides[0] == 0
        start = origins[:1].copy() if one else np.ascontiguousarray(origins)
        along = np.ascontiguousarray(directions)
        return Hits(*_hits_of(hits, start, along, self._planes, self._gradients, self._corners))

    def on_triangles(self, points: Floats, triangle: Ints) -> Hits:
        """Return the hits of points (N, 3), m, moved onto given triangles (N,)."""
        along = np.ascontiguousarray(-self.face_normals[triangle])
        planes, gradients = self._planes, self._gradients
        points = np.ascontiguousarray(points)
        return Hits(*_hits_of(triangle, points, along, planes, gradients, self._corners))

    def visible(self, points: Floats, targets: Floats, *, normals: Floats | None = None) -> Bools:
        """True where nothing stands between points and targets.

        In: points ((N, 3), m), targets ((N, 3) or (3,), m), normals (N, 3). Out: visible (N,).
        """
        none = np.zeros((0, 3))
        origins, spans = _sight(
            np.ascontiguousarray(points),
            none if normals is None else np.ascontiguousarray(normals),
            np.ascontiguousarray(np.atleast_2d(targets)),
            self._middle,
            1.0 / self._size,
            self.lift,
        )
        return ~self._engine.blocked(origins, spans)

    def _scaled(self, points: Floats) -> Floats:
        """Return points in the engine's coordinates."""
        if len(points) > 1 and points.strides[0] == 0:  # one point for all
            return np.broadcast_to(self._scaled(points[:1]), points.shape)
        scaled = points - self._middle
        scaled *= 1.0 / self._size
        return scaled


class Occlusion:
    """Whether anything of a mesh stands between points; quicker to build than a ray caster.

    In: vertices ((V, 3), m), faces (T, 3).
    """

    def __init__(self, vertices: Floats, faces: Ints) -> None:
        lower, upper = vertices.min(axis=0), vertices.max(axis=0)
        self._middle = (lower + upper) / 2.0
        self._scale = 1.0 / float(np.linalg.norm(upper - lower))
        scaled = (vertices - self._middle) * self._scale
        self._engine: _Engine = (
            _VtkEngine(scaled, faces) if EmbreeScene is None else _EmbreeEngine(scaled, faces)
        )

    def first(self, points: Floats, directions: Floats) -> Ints:
        """Return the triangle that each ray (N,) from a point, m, meets first; -1 for none."""
        return self._engine.first((points - self._middle) * self._scale, directions)

    def blocked(self, points: Floats, targets: Floats) -> Bools:
        """True where the segment from a point to its target (N,), m, meets a triangle, (N,)."""
        return self._engine.blocked(
            (points - self._middle) * self._scale, (targets - points) * self._scale
        )


DIRECTIONS = np.array([[0.62, 0.33, 0.71], [-0.45, 0.83, -0.33], [0.21, -0.56, -0.80]])
DIRECTIONS /= np.linalg.norm(DIRECTIONS, axis=1, keepdims=True)
"""Directions of the rays that tell inside from outside. The majority counts, because a ray may
slip between two triangles. None is parallel to an axis, because many faces are."""


def contains(vertices: ArrayLike, faces: ArrayLike, points: ArrayLike) -> Bools:
    """Return the mask of the points inside closed bodies: a ray leaves through what it meets first.

    In: vertices ((V, 3), m), faces (T, 3), points ((N, 3), m).
    """
    corners, places = np.asarray(vertices, dtype=np.float64), np.asarray(points, dtype=np.float64)
    triangles = np.asarray(faces)
    if not len(places) or not len(triangles):
        return np.zeros(len(places), dtype=bool)
    a, b, c = (corners[triangles[:, k]] for k in range(3))
    normals = np.cross(b - a, c - a)
    occlusion = Occlusion(corners, triangles)
    votes = np.zeros(len(places), dtype=int)
    for direction in DIRECTIONS:
        first = occlusion.first(places, np.broadcast_to(direction, places.shape))
        votes += (first >= 0) & (normals[first] @ direction > 0.0)
    return votes * 2 > len(DIRECTIONS)
