# SPDX-License-Identifier: MIT
"""One sphere: the scene whose echo is known on paper."""

from typing import Annotated

import trimesh
from pydantic import Field

from sononerf.scene import MATERIALS, MaterialName, Scene


def sphere(
    radius: Annotated[float, Field(gt=0)] = 0.015, material: MaterialName = "rigid"
) -> Scene:
    """Build a sphere of a radius (m) about the origin."""
    return Scene(trimesh.creation.icosphere(subdivisions=5, radius=radius), MATERIALS[material])
