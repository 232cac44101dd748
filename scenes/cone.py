# SPDX-License-Identifier: MIT
"""A cone: a tip, a surface that is curved one way, a flat base with a sharp edge."""

from sononerf.scene import MATERIALS, MaterialName, Scene

from .bodies import Degrees, Length, Radius, placed
from .lathe import lathe


def cone(
    radius: Radius = 0.04,
    height: Length = 0.09,
    yaw: Degrees = 0.0,
    pitch: Degrees = 0.0,
    roll: Degrees = 0.0,
    material: MaterialName = "rigid",
) -> Scene:
    """Build an upright cone: radius of its base and height (m), turned (degrees)."""
    mesh = lathe([(0.0, 0.0), (radius, 0.0), (0.0, height)])
    return Scene(placed(mesh, yaw, pitch, roll), MATERIALS[material])
