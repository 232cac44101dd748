# SPDX-License-Identifier: MIT
"""Spheres of mixed sizes that do not touch."""

from typing import Annotated

import numpy as np
import trimesh
from pydantic import Field

from sononerf.errors import SettingsError
from sononerf.scene import MATERIALS, MaterialName, Scene

from .bodies import Radius, ball, placed

GAP = 0.005
"""Least gap between two spheres, m, so that echoes resolve them."""
TRIES = 2000
"""Largest number of places that are tried for each sphere."""


def cluster(
    seed: Annotated[int, Field(ge=0, lt=2**32)] = 0,
    count: Annotated[int, Field(ge=1, le=100)] = 5,
    radius_min: Radius = 0.01,
    radius_max: Radius = 0.02,
    spread: Annotated[float, Field(gt=0, le=1)] = 0.07,
    material: MaterialName = "rigid",
) -> Scene:
    """Build so many spheres within a ball of a radius `spread` (m), drawn from a seed."""
    if radius_min > radius_max:
        raise SettingsError(
            f"scene.options.radius_min: found {radius_min:g}; must not exceed radius_max, "
            f"{radius_max:g}"
        )
    random = np.random.default_rng([seed, 0])
    # The largest first: small ones find their place among them.
    radii = np.sort(random.uniform(radius_min, radius_max, count))[::-1]
    centres = np.zeros((count, 3))
    for index, radius in enumerate(radii):
        for _ in range(TRIES):
            place = random.uniform(-spread, spread, 3)
            distance = np.linalg.norm(centres[:index] - place, axis=1)
            inside = np.linalg.norm(place) + radius <= spread
            if inside and (distance >= radii[:index] + radius + GAP).all():
                centres[index] = place
                break
        else:
            raise SettingsError(
                f"scene.options: {count} spheres of up to {radius_max:g} m with gaps of "
                f"{1000 * GAP:g} mm do not fit into a spread of {spread:g} m; raise spread, "
                "or lower count or radius_max"
            )
    mesh = trimesh.util.concatenate(
        [ball(centre, radius) for centre, radius in zip(centres, radii, strict=True)]
    )
    return Scene(placed(mesh), MATERIALS[material])
