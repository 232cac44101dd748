# SPDX-License-Identifier: MIT
"""A rubber duck: a household thing without edges."""

from __future__ import annotations

from typing import Annotated

import numpy as np
import trimesh
from numpy.typing import NDArray
from pydantic import Field
from skimage.measure import marching_cubes

from sononerf.scene import MATERIALS, MaterialName, Scene

from .bodies import Degrees, placed

ELLIPSOIDS = (
    ((0.0, 0.0, -0.015), (0.043, 0.032, 0.026), 0.0),  # body
    ((-0.04, 0.0, 0.004), (0.02, 0.014, 0.01), 0.6),  # tail
    ((0.02, 0.0, 0.028), (0.0215, 0.021, 0.021), 0.0),  # head
    ((0.043, 0.0, 0.022), (0.013, 0.012, 0.0055), -0.1),  # beak
    ((-0.006, 0.028, -0.008), (0.024, 0.008, 0.014), 0.2),  # wings
    ((-0.006, -0.028, -0.008), (0.024, 0.008, 0.014), 0.2),
)
"""Centre (m), half axes (m) and pitch (rad) of each part; x forward, z up; 114 mm long."""
LENGTH = 0.114
"""Length of these parts together, m."""
BLEND = 0.006
"""Distance over which parts flow into one another, m."""
SPACING = 0.0012
"""Side of the cells that are triangulated, m. Edges are then at most 2 mm, where the shortest
wavelength is 3.4 mm; a duck longer than 0.12 m would have longer ones."""


def duck(
    length: Annotated[float, Field(gt=0, le=0.12)] = LENGTH,
    yaw: Degrees = 0.0,
    pitch: Degrees = 0.0,
    roll: Degrees = 0.0,
    material: MaterialName = "rigid",
) -> Scene:
    """Build a rubber duck of a length (m); it is turned by yaw, pitch and roll (degrees)."""
    axes = [np.arange(-reach, reach, SPACING) for reach in (0.066, 0.045, 0.06)]
    places = np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1)
    distances = [_distance(places, *part) for part in ELLIPSOIDS]
    joined = -BLEND * np.log(np.sum(np.exp(-np.stack(distances) / BLEND), axis=0))
    vertices, faces, _, _ = marching_cubes(joined, 0.0, spacing=(SPACING,) * 3)
    mesh = trimesh.Trimesh(vertices, faces)
    if mesh.volume < 0.0:
        mesh.invert()
    mesh = trimesh.smoothing.filter_taubin(mesh, iterations=10)
    mesh.apply_translation(-mesh.bounds.mean(axis=0))
    mesh.apply_scale(length / mesh.extents[0])
    return Scene(placed(mesh, yaw, pitch, roll), MATERIALS[material])


def _distance(
    places: NDArray[np.float64],
    centre: tuple[float, float, float],
    radii: tuple[float, float, float],
    pitch: float,
) -> NDArray[np.float64]:
    """Return about the signed distance (m) of places (..., 3) from an ellipsoid."""
    x, y, z = np.moveaxis(places - centre, -1, 0)
    turned = np.stack(
        [np.cos(pitch) * x - np.sin(pitch) * z, y, np.sin(pitch) * x + np.cos(pitch) * z], axis=-1
    )
    near = np.linalg.norm(turned / radii, axis=-1)
    slope = np.linalg.norm(turned / np.square(radii), axis=-1)
    return np.asarray(near * (near - 1.0) / np.maximum(slope, 1e-9), dtype=np.float64)
