# SPDX-License-Identifier: MIT
"""Nineteen spheres that spell "UA", the second scene of the SonoNERF paper."""

from typing import Annotated

from pydantic import Field

from sononerf.scene import MaterialName, Scene

from .spheres import spheres

# Centres as (y, z) in radii; four pairs overlap, the others leave gaps of 0.1 to 4 mm.
LETTER_U = (
    *((-6.19, 6.25), (-6.19, 4.21), (-6.19, 2.11), (-5.64, 0.22), (-3.77, 0.0)),
    *((-1.75, 0.32), (-1.49, 2.40), (-1.41, 4.42), (-1.38, 6.51)),
)
LETTER_A = (
    *((1.50, 0.0), (2.04, 1.93), (2.64, 3.78), (3.09, 5.75), (4.14, 7.54)),
    *((5.12, 5.74), (5.70, 3.83), (6.30, 1.91), (6.93, -0.01), (4.16, 1.89)),
)


def ua(
    radius: Annotated[float, Field(gt=0)] = 1.0 / 35.0, material: MaterialName = "rigid"
) -> Scene:
    """Build "UA" from spheres of a radius (m), their mean at the origin."""
    centres = tuple((0.0, y, z) for y, z in (*LETTER_U, *LETTER_A))
    return spheres(centres, radius, subdivisions=4, material=material)
