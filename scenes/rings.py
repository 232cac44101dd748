# SPDX-License-Identifier: MIT
"""Two tori, one through the other: two parts that cannot be told apart by a plane."""

import trimesh

from sononerf.errors import SettingsError
from sononerf.scene import MATERIALS, MaterialName, Scene

from .bodies import Degrees, Radius, placed, turned
from .torus import ring


def rings(
    major_radius: Radius = 0.035,
    minor_radius: Radius = 0.007,
    yaw: Degrees = 0.0,
    pitch: Degrees = 0.0,
    roll: Degrees = 0.0,
    material: MaterialName = "rigid",
) -> Scene:
    """Build two linked tori of the same two radii (m), at a right angle, turned (degrees)."""
    if 2.0 * minor_radius >= major_radius:
        raise SettingsError(
            f"scene.options.minor_radius: found {minor_radius:g}; must lie below half of "
            f"major_radius, {major_radius / 2.0:g}"
        )
    lying = ring(major_radius, minor_radius)
    # The upright one runs through the middle of the other.
    upright = turned(lying, roll=90.0).apply_translation((major_radius, 0.0, 0.0))
    mesh = trimesh.util.concatenate([lying, upright])
    return Scene(placed(mesh, yaw, pitch, roll), MATERIALS[material])
