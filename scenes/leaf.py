# SPDX-License-Identifier: MIT
"""A leaf: a thin sheet that is bent both ways, with ribs."""

from typing import Annotated

import numpy as np
import trimesh
from pydantic import Field

from sononerf.errors import SettingsError
from sononerf.scene import MATERIALS, MaterialName, Scene

from .blade import Blade
from .bodies import EDGE, Degrees, turned
from .sheet import filled, two_sided

SPACING = 0.55 * EDGE
"""Spacing of the vertices on the flat blade, m; ribs and the rim lengthen edges by up to 1.8."""

Seed = Annotated[int, Field(ge=0, lt=2**32)]
LeafLength = Annotated[float, Field(ge=0.04, le=0.25)]
LeafWidth = Annotated[float, Field(ge=0.02, le=0.15)]
Curl = Annotated[float, Field(ge=-120, le=120)]
"""Degrees. Together with those of the bend and the width, these bounds keep the blade unfolded."""
Bend = Annotated[float, Field(ge=-90, le=90)]
"""Degrees."""
Thickness = Annotated[float, Field(ge=2e-4, le=1e-3)]
Undulation = Annotated[float, Field(ge=0, le=2e-3)]


def blade_of(
    seed: int,
    length: float,
    width: float,
    curl: float,
    bend: float,
    thickness: float,
    undulation: float,
) -> Blade:
    """Return the blade of a leaf's options (m, degrees).

    Raises:
        SettingsError: If it is wider than long: its curled edges could then meet where it is bent.
    """
    if width > length:
        raise SettingsError(
            f"scene.options.width: found {width:g}; must not exceed length, {length:g}"
        )
    return Blade.drawn(
        seed,
        length=length,
        width=width,
        thickness=thickness,
        curl=float(np.radians(curl)),
        bend=float(np.radians(bend)),
        undulation=undulation,
    )


def surface_of(blade: Blade) -> trimesh.Trimesh:
    """Return both sides and the rim of a blade, its middle in the origin, not turned."""
    places, triangles = filled(blade.outline, SPACING / blade.stretch())
    # Along is z and across is y, so from the upper side, +x, triangles run clockwise.
    return two_sided(blade.lower(*places.T), blade.upper(*places.T), triangles)


def leaf(
    seed: Seed = 0,
    length: LeafLength = 0.18,
    width: LeafWidth = 0.1,
    curl: Curl = 60.0,
    bend: Bend = 30.0,
    thickness: Thickness = 4e-4,
    undulation: Undulation = 7e-4,
    yaw: Degrees = 0.0,
    pitch: Degrees = 0.0,
    roll: Degrees = 0.0,
    material: MaterialName = "leaf",
) -> Scene:
    """Build a leaf whose upper side faces x, tip up; the middle of its blade is the origin.

    Curl (degrees) is from edge to edge, above 0 towards the upper side; bend from base to tip,
    above 0 away from it; the seed draws veins and an undulation (m, root mean square).
    """
    blade = blade_of(seed, length, width, curl, bend, thickness, undulation)
    return Scene(turned(surface_of(blade), yaw, pitch, roll), MATERIALS[material])
