# SPDX-License-Identifier: MIT
"""A rigid plane that mirrors sound, and the bodies on it with their images."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, overload

import numpy as np
import trimesh

from sononerf.errors import InputError
from sononerf.numerics import Bools, Floats

if TYPE_CHECKING:
    from torch import Tensor

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
    def turn(self) -> Floats:
        """Matrix (3, 3) that mirrors vectors (..., 3) by multiplication from either side."""
        normal = np.asarray(self.normal)
        return np.eye(3) - 2.0 * np.outer(normal, normal)

    def mirrored(self, points: Floats) -> Floats:
        """Return the images (..., 3) of points (..., 3), m."""
        at = np.asarray(self.point)
        return (np.asarray(points) - at) @ self.turn + at

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
