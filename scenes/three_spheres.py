# SPDX-License-Identifier: MIT
"""Three spheres in an L, the first scene of the SonoNERF paper."""

from typing import Annotated

from pydantic import Field

from sononerf.scene import MaterialName, Scene

from .spheres import spheres

CENTRES = ((0.0, 2.49, 2.45), (0.0, 2.47, -0.83), (0.0, -1.80, -0.83))  # radii


def three_spheres(
    radius: Annotated[float, Field(gt=0)] = 0.015, material: MaterialName = "rigid"
) -> Scene:
    """Build three spheres of a radius (m), their mean at the origin."""
    return spheres(CENTRES, radius, subdivisions=5, material=material)
