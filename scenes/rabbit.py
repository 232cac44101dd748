# SPDX-License-Identifier: MIT
"""A rabbit: a loud body under a head with two thin ears, as small animals are heard."""

from typing import Annotated

import numpy as np
import trimesh
from pydantic import Field

from sononerf.geometry.poses import rotation_from_euler
from sononerf.scene import MATERIALS, MaterialName, Scene

from .bodies import Degrees, ball, placed

PARTS = (
    # middle, half axes, pitch and yaw in degrees; lengths over the height of the animal
    ((0.00, 0.00, 0.26), (0.34, 0.25, 0.27), -8.0, 0.0),  # body
    ((-0.14, 0.00, 0.22), (0.23, 0.26, 0.22), 0.0, 0.0),  # haunches
    ((0.30, 0.00, 0.52), (0.18, 0.14, 0.15), 20.0, 0.0),  # head
    ((0.22, 0.00, 0.38), (0.16, 0.14, 0.18), -30.0, 0.0),  # neck
    ((0.20, 0.09, 0.78), (0.045, 0.07, 0.22), -14.0, 15.0),  # left ear
    ((0.20, -0.09, 0.78), (0.045, 0.07, 0.22), -14.0, -15.0),  # right ear
    ((0.27, 0.10, 0.06), (0.16, 0.06, 0.06), 0.0, 10.0),  # forefeet
    ((0.27, -0.10, 0.06), (0.16, 0.06, 0.06), 0.0, -10.0),
    ((-0.38, 0.00, 0.20), (0.08, 0.08, 0.08), 0.0, 0.0),  # tail
)
"""Ellipsoids of the animal; they overlap."""


def rabbit(
    height: Annotated[float, Field(gt=0.02, le=0.4)] = 0.12,
    yaw: Degrees = 0.0,
    pitch: Degrees = 0.0,
    roll: Degrees = 0.0,
    material: MaterialName = "rigid",
) -> Scene:
    """Build a sitting rabbit out of ellipsoids, height from base to the tips of the ears (m)."""
    bodies = []
    for middle, axes, tilt, turn in PARTS:
        part = ball((0.0, 0.0, 0.0), height * max(axes))
        rotation = rotation_from_euler(np.radians(turn), np.radians(tilt), 0.0)
        vertices = part.vertices * (np.array(axes) / max(axes)) @ rotation.T
        bodies.append(trimesh.Trimesh(vertices + height * np.array(middle), part.faces))
    return Scene(placed(trimesh.util.concatenate(bodies), yaw, pitch, roll), MATERIALS[material])
