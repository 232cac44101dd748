# SPDX-License-Identifier: MIT
"""Equal spheres put together: what the sphere scenes share."""

from collections.abc import Sequence

import numpy as np
import trimesh

from sononerf.scene import MATERIALS, MaterialName, Scene


def spheres(
    centres: Sequence[tuple[float, float, float]],
    radius: float,
    *,
    subdivisions: int,
    material: MaterialName,
) -> Scene:
    """Build spheres of a radius (m) at centres (in radii) whose mean becomes the origin."""
    places = radius * np.asarray(centres, dtype=np.float64)
    places -= places.mean(axis=0)
    bodies = []
    for place in places:
        body = trimesh.creation.icosphere(subdivisions=subdivisions, radius=radius)
        body.apply_translation(place)
        bodies.append(body)
    return Scene(trimesh.util.concatenate(bodies), MATERIALS[material])
