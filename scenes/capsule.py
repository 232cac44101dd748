# SPDX-License-Identifier: MIT
"""A capsule: a rod with round ends, curved one way."""

from sononerf.scene import MATERIALS, MaterialName, Scene

from .bodies import Degrees, Length, Radius, placed, tube


def capsule(
    length: Length = 0.06,
    radius: Radius = 0.015,
    yaw: Degrees = 0.0,
    pitch: Degrees = 0.0,
    roll: Degrees = 0.0,
    material: MaterialName = "rigid",
) -> Scene:
    """Build an upright capsule: length of the straight part and radius (m), turned (degrees)."""
    mesh = tube([(0.0, -length / 2.0), (0.0, length / 2.0)], radius)
    return Scene(placed(mesh, yaw, pitch, roll), MATERIALS[material])
