# SPDX-License-Identifier: MIT
"""A rectangular plate: the scene whose echo is a mirror's."""

from typing import Annotated

import trimesh
from pydantic import Field

from sononerf.scene import MATERIALS, MaterialName, Scene

from .bodies import Degrees, Length, placed


def plate(
    sides: tuple[Length, Length] = (0.1, 0.1),
    thickness: Annotated[float, Field(ge=1e-4, le=0.05)] = 1e-3,
    yaw: Degrees = 0.0,
    pitch: Degrees = 0.0,
    roll: Degrees = 0.0,
    material: MaterialName = "rigid",
) -> Scene:
    """Build a plate that faces x: sides along y and z and thickness (m), turned (degrees)."""
    # Fine triangles stand in for curvature. A flat face has none: rays find it as well in two.
    mesh = trimesh.creation.box((thickness, *sides))
    return Scene(placed(mesh, yaw, pitch, roll), MATERIALS[material])
