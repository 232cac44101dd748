# SPDX-License-Identifier: MIT
"""A prism over a star: sharp edges, and corners that are dihedral mirrors."""

from typing import Annotated

import numpy as np
import trimesh
from pydantic import Field

from sononerf.scene import MATERIALS, MaterialName, Scene

from .bodies import Degrees, Length, Radius, placed, walls


def star(
    radius: Radius = 0.04,
    height: Length = 0.06,
    points: Annotated[int, Field(ge=3, le=12)] = 5,
    depth: Annotated[float, Field(ge=0, le=0.8)] = 0.45,
    yaw: Degrees = 0.0,
    pitch: Degrees = 0.0,
    roll: Degrees = 0.0,
    material: MaterialName = "rigid",
) -> Scene:
    """Build an upright prism: radius and height (m), points, and how far the notches reach inward.

    A depth of 0 puts the notches on the circle of the points, one of 0.8 at a fifth of its radius.
    """
    angle = np.pi * np.arange(2 * points) / points
    distance = np.where(np.arange(2 * points) % 2, radius * (1.0 - depth), radius)
    outline = np.stack((distance * np.cos(angle), distance * np.sin(angle)), axis=1)
    count = len(outline)
    rings = [np.column_stack((outline, np.full(count, z))) for z in (0.0, height)]
    middles = np.array([[0.0, 0.0, 0.0], [0.0, 0.0, height]])
    ring = np.arange(count)
    beside = np.roll(ring, -1)
    base = np.stack((np.full(count, 2 * count), beside, ring), axis=1)
    top = np.stack((np.full(count, 2 * count + 1), count + ring, count + beside), axis=1)
    faces = np.concatenate((walls(2, count, closed=False), base, top))
    mesh = trimesh.Trimesh(np.concatenate((*rings, middles)), faces, process=False)
    return Scene(placed(mesh, yaw, pitch, roll), MATERIALS[material])
