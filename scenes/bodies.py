# SPDX-License-Identifier: MIT
"""Round bodies, fine enough for sound, and how they are placed: what several scenes share."""

import math
from typing import Annotated

import numpy as np
import trimesh
from numpy.typing import ArrayLike, NDArray
from pydantic import Field

from sononerf.geometry.poses import rotation_from_euler

EDGE = 1.5e-3
"""Longest edge of a curved surface in m; less than half the shortest wavelength, 3.4 mm."""
SIDE = EDGE / math.sqrt(2.0)
"""Side of a square whose diagonal is as long as that."""
ICOSAHEDRON_EDGE = 1.33
"""Longest edge of an icosphere in radii, times 2 to the power of its subdivisions."""

Degrees = Annotated[float, Field(ge=-360, le=360)]
Length = Annotated[float, Field(gt=0, le=0.5)]
"""An edge or a straight part, in m."""
Radius = Annotated[float, Field(gt=0, le=0.2)]
"""In m. A mesh grows with its square, so that it has a bound."""
Wire = Annotated[float, Field(ge=2.2e-3, le=0.02)]
"""Radius of a wire or rod in m. From 2.2 mm on it has more than 12 sides, so that they meet at less
than 30 degrees and are heard as one round surface."""


def ball(centre: ArrayLike, radius: float) -> trimesh.Trimesh:
    """Build a sphere about a centre (3,) m, of a radius (m)."""
    subdivisions = max(2, math.ceil(math.log2(ICOSAHEDRON_EDGE * radius / EDGE)))
    body = trimesh.creation.icosphere(subdivisions=subdivisions, radius=radius)
    body.apply_translation(np.asarray(centre, dtype=np.float64))
    return body


def sections(length: float) -> int:
    """Return into how many sides a circle of a circumference (m) is divided."""
    return max(12, math.ceil(length / SIDE))


def tube(path: ArrayLike, radius: float) -> trimesh.Trimesh:
    """Build a tube with round ends, or a closed one where the path ends where it began.

    Args:
        path ((N, 2), m): Points (y, z) of a line without corners; bends of a smaller radius than
            the tube's would fold it.
        radius (m): Radius of the tube.

    Returns:
        body: Closed, facing outward, in the y-z plane.
    """
    points = np.asarray(path, dtype=np.float64)
    closed = bool(np.allclose(points[0], points[-1]))
    middle, along = _even(points, closed)
    width = np.full(len(middle), radius)
    tips = middle[[0, -1]] + radius * along[[0, -1]] * [[-1.0], [1.0]]
    if not closed:
        # The ends are half spheres: circles that shrink as they move on.
        turns = max(3, math.ceil(0.5 * np.pi * radius / SIDE))
        angle = 0.5 * np.pi * np.arange(1, turns)[:, None] / turns
        start = middle[0] - radius * np.sin(angle[::-1]) * along[0]
        end = middle[-1] + radius * np.sin(angle) * along[-1]
        shrunk = radius * np.cos(angle[:, 0])
        middle = np.concatenate((start, middle, end))
        along = np.pad(along, ((turns - 1, turns - 1), (0, 0)), mode="edge")
        width = np.concatenate((shrunk[::-1], width, shrunk))
    count = sections(2.0 * np.pi * radius)
    around = 2.0 * np.pi * np.arange(count) / count
    # Across the line lie x and, within the plane, the line's direction turned by a right angle.
    aside = np.stack((along[:, 1], -along[:, 0]), axis=1)
    rings = np.zeros((len(middle), count, 3))
    rings[..., 0] = width[:, None] * np.cos(around)
    rings[..., 1:] = middle[:, None]
    rings[..., 1:] += (width[:, None] * np.sin(around))[..., None] * aside[:, None]
    vertices = rings.reshape(-1, 3)
    faces = walls(len(middle), count, closed)
    if not closed:
        ring, size = np.arange(count), len(vertices)
        beside, last = np.roll(ring, -1), size - count
        first_cap = np.stack((np.full(count, size), beside, ring), axis=1)
        last_cap = np.stack((np.full(count, size + 1), last + ring, last + beside), axis=1)
        vertices = np.concatenate((vertices, np.pad(tips, ((0, 0), (1, 0)))))
        faces = np.concatenate((faces, first_cap, last_cap))
    return trimesh.Trimesh(vertices, faces, process=False)


def _even(
    points: NDArray[np.float64], closed: bool
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Return points evenly along a path and the directions there, both (M, 2)."""
    length = np.concatenate(([0.0], np.cumsum(np.linalg.norm(np.diff(points, axis=0), axis=1))))
    # Closer where it may bend, since the tube's outside is longer there.
    step = SIDE if len(points) == 2 else 0.75 * SIDE
    count = max(3, math.ceil(length[-1] / step)) + 1
    at = np.linspace(0.0, length[-1], count)
    even = np.stack([np.interp(at, length, points[:, axis]) for axis in range(2)], axis=1)
    if closed:
        even = even[:-1]
        along = np.roll(even, -1, axis=0) - np.roll(even, 1, axis=0)
    else:
        along = np.gradient(even, axis=0)
    return even, along / np.linalg.norm(along, axis=1, keepdims=True)


def walls(rows: int, columns: int, closed: bool) -> NDArray[np.int64]:
    """Return the triangles between neighbouring rings of points, numbered row by row, (T, 3).

    They face outward where the rings run counter-clockwise about the direction of the rows.
    """
    number = np.arange(rows * columns).reshape(rows, columns)
    ahead = np.roll(number, -1, axis=0) if closed else number[1:]
    here = number if closed else number[:-1]
    right, ahead_right = np.roll(here, -1, axis=1), np.roll(ahead, -1, axis=1)
    squares = [(here, right, ahead_right), (here, ahead_right, ahead)]
    return np.concatenate([np.stack(corners, axis=-1).reshape(-1, 3) for corners in squares])


def placed(
    mesh: trimesh.Trimesh, yaw: float = 0.0, pitch: float = 0.0, roll: float = 0.0
) -> trimesh.Trimesh:
    """Turn a mesh, then move the middle of its bounding box to the origin.

    Args:
        mesh: Metres; stays as it is.
        yaw, pitch, roll (degrees): Turns about z, y and x, roll first, as a head's.

    Returns:
        mesh: At the origin, at which poses look.
    """
    vertices = np.asarray(mesh.vertices) @ _rotation(yaw, pitch, roll).T
    vertices -= (vertices.min(axis=0) + vertices.max(axis=0)) / 2.0
    return rounded(vertices, mesh.faces)


def turned(
    mesh: trimesh.Trimesh, yaw: float = 0.0, pitch: float = 0.0, roll: float = 0.0
) -> trimesh.Trimesh:
    """Turn a mesh as :func:`placed` does, but about the origin, which stays where it is."""
    return rounded(np.asarray(mesh.vertices) @ _rotation(yaw, pitch, roll).T, mesh.faces)


def _rotation(yaw: float, pitch: float, roll: float) -> NDArray[np.float64]:
    return rotation_from_euler(*np.radians((yaw, pitch, roll)))


def rounded(vertices: NDArray[np.float64], faces: NDArray[np.int64]) -> trimesh.Trimesh:
    """Build a mesh of vertices (V, 3) m, to a nanometre, and triangles (T, 3)."""
    # The last bits of a sine are the processor's own; the same scene has the same echoes' hash.
    return trimesh.Trimesh(vertices.round(9) + 0.0, faces, process=False)
