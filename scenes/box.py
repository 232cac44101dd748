# SPDX-License-Identifier: MIT
"""A box: flat faces, sharp edges and corners."""

import trimesh

from sononerf.scene import MATERIALS, MaterialName, Scene

from .bodies import Degrees, Length, placed


def box(
    size: tuple[Length, Length, Length] = (0.08, 0.06, 0.05),
    yaw: Degrees = 0.0,
    pitch: Degrees = 0.0,
    roll: Degrees = 0.0,
    material: MaterialName = "rigid",
) -> Scene:
    """Build a box of three edge lengths (m), turned by yaw, pitch and roll (degrees)."""
    return Scene(placed(trimesh.creation.box(size), yaw, pitch, roll), MATERIALS[material])
