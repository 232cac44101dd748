# SPDX-License-Identifier: MIT
"""Triangle meshes: normals, bodies, faults; and the plane that mirrors them."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import TYPE_CHECKING, overload

import numpy as np
import trimesh
from numpy.typing import NDArray
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components
from trimesh.grouping import group_rows

from sononerf.errors import InputError
from sononerf.numerics import Bools, Floats, Ints

if TYPE_CHECKING:
    from torch import Tensor

CREASE = math.radians(30.0)
TIGHTER = 0.95  # radius of balls around halves, over that around the whole, that is worth it


def corner_normals(mesh: trimesh.Trimesh, *, crease: float = CREASE) -> Floats:
    """Smooth normal at each corner of each triangle.

    Around a vertex, triangles are taken together as far as their neighbours meet at less than
    the crease angle, so a sphere is smooth and a box keeps its edges. The weights are those of
    Max [1]_: exact wherever a vertex and its neighbours lie on one sphere.

    In: crease (rad). Out: normals (T, 3, 3).

    References:
        .. [1] N. Max, "Weights for computing vertex normals from facet normals", Journal of
           Graphics Tools 4(2), 1999.
    """
    faces = np.asarray(mesh.faces)
    corners = mesh.vertices.view(np.ndarray)[faces]  # (T, 3, 3)
    ahead = np.roll(corners, -1, axis=1) - corners
    behind = np.roll(corners, 1, axis=1) - corners
    weight = (ahead**2).sum(-1) * (behind**2).sum(-1)  # (T, 3)
    share = np.cross(ahead, behind) / np.where(weight > 0.0, weight, np.inf)[..., None]
    group = _smooth_corners(mesh, crease)
    summed = np.stack([np.bincount(group, share[..., axis].ravel()) for axis in range(3)], axis=-1)
    length = np.linalg.norm(summed, axis=1, keepdims=True)
    normals = np.divide(summed, length, out=np.zeros_like(summed), where=length > 0.0)
    return normals[group].reshape(-1, 3, 3)


def total_curvature(mesh: trimesh.Trimesh, normals: Floats) -> Floats:
    """Total curvature of the smooth surface over each triangle.

    The square root of the sum of both principal curvatures' squares, which is the Frobenius norm
    of the map from a step along the surface to the normal's change; the normals at the corners
    give that map, as in Rusinkiewicz [1]_. Edges are no part of it.

    In: normals (T, 3, 3). Out: curvature ((T,), 1/m).

    References:
        .. [1] S. Rusinkiewicz, "Estimating curvatures and their derivatives on triangle meshes",
           3DPVT 2004.
    """
    corners = mesh.vertices.view(np.ndarray)[np.asarray(mesh.faces)]
    second, third = weight_gradients(corners)
    to_second, to_third = normals[:, 1] - normals[:, 0], normals[:, 2] - normals[:, 0]
    square = (to_second**2).sum(1) * (second**2).sum(1)
    square += (to_third**2).sum(1) * (third**2).sum(1)
    square += 2.0 * (to_second * to_third).sum(1) * (second * third).sum(1)
    return np.sqrt(np.maximum(square, 0.0))


def weight_gradients(corners: Floats) -> tuple[Floats, Floats]:
    """Gradients of the barycentric weights of a triangle's second and third corner.

    In: corners ((T, 3, 3), m). Out: second, third ((T, 3), 1/m).
    """
    ab, ac = corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]
    sides = np.cross(ab, ac)
    square = (sides**2).sum(1, keepdims=True)
    square = np.where(square > 0.0, square, np.inf)
    return np.cross(ac, sides) / square, np.cross(sides, ab) / square


def _smooth_corners(mesh: trimesh.Trimesh, crease: float) -> NDArray[np.int32]:
    """Return a number per corner (3 T), the same for those that share a normal."""
    faces = np.asarray(mesh.faces)
    smooth = mesh.face_adjacency_angles < crease
    pairs = mesh.face_adjacency[smooth]  # two triangles
    edges = mesh.face_adjacency_edges[smooth]  # and the two vertices they share
    first: list[Ints] = []
    second: list[Ints] = []
    for end in range(2):
        for side, found in ((0, first), (1, second)):
            corner = (faces[pairs[:, side]] == edges[:, end, None]).argmax(axis=1)
            found.append(3 * pairs[:, side] + corner)
    rows, columns = np.concatenate(first), np.concatenate(second)
    size = faces.size
    links = coo_array((np.ones(len(rows), dtype=bool), (rows, columns)), shape=(size, size))
    return connected_components(links, directed=False)[1]


def bodies(mesh: trimesh.Trimesh) -> Ints:
    """Return the number of the connected part of each triangle (T,)."""
    count = len(mesh.faces)
    pairs = np.asarray(mesh.face_adjacency, dtype=np.int64).reshape(-1, 2)
    graph = coo_array((np.ones(len(pairs)), pairs.T), shape=(count, count))
    return connected_components(graph, directed=False)[1].astype(np.int64)


def enclosing_balls(corners: Floats, label: Ints, count: int) -> tuple[Floats, Floats]:
    """Return balls that hold all triangles: one for each body, and more where that is tighter.

    In: corners ((T, 3, 3), m), label (T,). Out: centres ((B, 3), m), radii ((B,), m).
    """
    middles = corners.mean(axis=1)

    def ball(group: Ints) -> tuple[Floats, float, Ints]:
        points = corners[group].reshape(-1, 3)
        centre = 0.5 * (points.min(axis=0) + points.max(axis=0))
        return centre, float(np.linalg.norm(points - centre, axis=1).max()), group

    bodies = np.unique(label)
    alone = [np.flatnonzero(label == body) for body in bodies] if len(bodies) <= count else []
    open_ = [ball(group) for group in alone or [np.arange(len(corners))]]
    done: list[tuple[Floats, float, Ints]] = []
    while open_ and len(open_) + len(done) < count:
        whole = open_.pop(int(np.argmax([radius for _, radius, _ in open_])))
        group = whole[2]
        axis = int(np.ptp(middles[group], axis=0).argmax())
        group = group[np.argsort(middles[group, axis], kind="stable")]
        halves = [ball(half) for half in np.array_split(group, 2) if len(half)]
        # Halves of a sphere fill balls that are larger than that of the sphere.
        if max(radius for _, radius, _ in halves) < TIGHTER * whole[1]:
            open_ += halves
        else:
            done.append(whole)
    found = open_ + done
    return np.stack([centre for centre, _, _ in found]), np.array([r for _, r, _ in found])


MIN_TRIANGLE_HEIGHT = 1e-7
"""Height of a triangle over the size of the surface below which it has no area in single
precision."""


def surface_faults(mesh: trimesh.Trimesh) -> list[str]:
    """Return the faults of a surface."""
    lines = []
    good = mesh.nondegenerate_faces(height=MIN_TRIANGLE_HEIGHT * float(mesh.scale))
    if not good.all():
        lines.append(
            f"the mesh has {_count((~good).sum(), 'triangle')} without area; nothing is heard there"
        )
    whole = trimesh.Trimesh(mesh.vertices, mesh.faces[good], process=False)
    if not whole.is_watertight:
        alone = len(group_rows(whole.edges_sorted, require_count=1))
        said = f"the mesh is open ({_count(alone, 'edge')} of one triangle alone"
        if not alone:
            said = "the mesh is open (edges are shared by more than two triangles"
        merged = whole.copy()
        merged.merge_vertices()
        if merged.is_watertight:
            said += "; vertices are there twice, merging them would close it"
        lines.append(f"{said}); volumes will not be measured")
    elif not whole.is_winding_consistent:
        lines.append("the mesh's triangles do not agree on which side is outside")
    elif whole.volume < 0.0:
        lines.append("the mesh is inside out; echoes do not mind, volumes do")
    return lines


def _count(number: int, what: str) -> str:
    return f"{number} {what}{'' if number == 1 else 's'}"


ON_PLANE = 1e-6
"""Height over the plane, as a fraction of the size of a mesh, below which a vertex lies on it: ten
times the rounding of single precision, in which mesh files are written."""


@dataclass(frozen=True)
class Plane:
    """A rigid plane."""

    point: tuple[float, float, float]  # (3,), m: On the plane, world frame
    normal: tuple[float, float, float]  # (3,): Unit vector towards the side of the body

    @classmethod
    def through(cls, point: Floats, normal: Floats) -> Plane:
        """Return the plane through a point (3,), m, with a normal (3,) of any length."""
        x, y, z = (float(part) for part in point)
        a, b, c = (float(part) for part in np.asarray(normal) / np.linalg.norm(normal))
        return cls((x, y, z), (a, b, c))

    @overload
    def height(self, points: Floats) -> Floats: ...
    @overload
    def height(self, points: Tensor) -> Tensor: ...
    def height(self, points: Floats | Tensor) -> Floats | Tensor:
        """Return the heights (...,) of points (..., 3) over the plane, m."""
        x, y, z = (points[..., axis] - self.point[axis] for axis in range(3))
        a, b, c = self.normal
        return a * x + b * y + c * z

    @property
    def reflection(self) -> Floats:
        """Matrix (3, 3) that mirrors vectors (..., 3) by multiplication from either side."""
        normal = np.asarray(self.normal)
        return np.eye(3) - 2.0 * np.outer(normal, normal)

    def mirrored(self, points: Floats) -> Floats:
        """Return the images (..., 3) of points (..., 3), m."""
        at = np.asarray(self.point)
        return (np.asarray(points) - at) @ self.reflection + at

    def with_image(self, mesh: trimesh.Trimesh) -> tuple[trimesh.Trimesh, Bools | None]:
        """Return the part of a mesh above the plane, and its image, as one mesh.

        Faces that lie on the plane are left out: sound reaches none of them. A closed body that
        stands on the plane and its image are then one closed body.

        Out: kept (T,).
        """
        heights = self.height(np.asarray(mesh.vertices))
        least = ON_PLANE * float(np.ptp(np.asarray(mesh.vertices), axis=0).max())
        if not (heights > least).any():
            raise InputError("the mesh lies below its support; raise it, or move support.point")
        cut = bool((heights < -least).any())
        if cut:
            vertices, faces, _ = trimesh.intersections.slice_faces_plane(
                np.asarray(mesh.vertices), np.asarray(mesh.faces), self.normal, self.point
            )
            heights = self.height(vertices)
        else:
            vertices, faces = np.array(mesh.vertices, dtype=np.float64), np.asarray(mesh.faces)
        on = np.abs(heights) <= least
        vertices[on] -= heights[on, None] * np.asarray(self.normal)
        kept = ~on[faces].all(axis=1)
        faces = faces[kept]
        image = self.mirrored(vertices)
        image[on] = vertices[on]
        # Vertices on the plane are shared; an image turns its triangles inside out.
        other = np.where(on, np.arange(len(vertices)), len(vertices) + np.arange(len(vertices)))
        both = np.concatenate([faces, other[faces][:, ::-1]])
        joined = trimesh.Trimesh(np.concatenate([vertices, image]), both, process=False)
        joined.merge_vertices()
        joined.remove_unreferenced_vertices()
        return joined, None if cut else kept
