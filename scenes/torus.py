# SPDX-License-Identifier: MIT
"""A torus: a hole, and a surface that is curved both ways."""

import math

import trimesh

from sononerf.errors import SettingsError
from sononerf.scene import MATERIALS, MaterialName, Scene

from .bodies import Degrees, Radius, placed, sections


def torus(
    major_radius: Radius = 0.04,
    minor_radius: Radius = 0.013,
    yaw: Degrees = 0.0,
    pitch: Degrees = 0.0,
    roll: Degrees = 0.0,
    material: MaterialName = "rigid",
) -> Scene:
    """Build a torus about the z axis of two radii (m), turned by yaw, pitch and roll (degrees)."""
    if minor_radius >= major_radius:
        raise SettingsError(
            f"scene.options.minor_radius: found {minor_radius:g}; must lie below major_radius, "
            f"{major_radius:g}"
        )
    mesh = ring(major_radius, minor_radius)
    return Scene(placed(mesh, yaw, pitch, roll), MATERIALS[material])


def ring(major_radius: float, minor_radius: float) -> trimesh.Trimesh:
    """Build the surface of a torus about the z axis, of two radii (m)."""
    return trimesh.creation.torus(
        major_radius,
        minor_radius,
        major_sections=sections(2.0 * math.pi * (major_radius + minor_radius)),
        minor_sections=sections(2.0 * math.pi * minor_radius),
    )
