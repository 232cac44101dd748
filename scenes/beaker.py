# SPDX-License-Identifier: MIT
"""A beaker: a hollow body, open on top, with walls on both sides of which sound is reflected."""

from typing import Annotated

from pydantic import Field

from sononerf.errors import SettingsError
from sononerf.scene import MATERIALS, MaterialName, Scene

from .bodies import Degrees, Length, Radius, placed
from .lathe import lathe

Wall = Annotated[float, Field(ge=5e-4, le=0.05)]
"""In m."""


def beaker(
    radius: Radius = 0.04,
    height: Length = 0.09,
    wall: Wall = 0.004,
    yaw: Degrees = 0.0,
    pitch: Degrees = 0.0,
    roll: Degrees = 0.0,
    material: MaterialName = "rigid",
) -> Scene:
    """Build an upright beaker, open on top: outer radius, height, thickness of wall and floor (m).

    It is turned by yaw, pitch and roll (degrees).
    """
    limit, of = min((radius, "radius"), (height, "height"))
    if wall >= limit:
        raise SettingsError(f"scene.options.wall: found {wall:g}; must lie below {of}, {limit:g}")
    inner = radius - wall
    profile = [(0.0, 0.0), (radius, 0.0), (radius, height), (inner, height)]
    mesh = lathe([*profile, (inner, wall), (0.0, wall)])
    return Scene(placed(mesh, yaw, pitch, roll), MATERIALS[material])
