# SPDX-License-Identifier: MIT
"""A leaf with a dragonfly on it: prey that sits still in front of what hides it."""

from typing import Annotated

import numpy as np
from pydantic import Field

from sononerf.errors import SettingsError
from sononerf.scene import MATERIALS, MaterialName, Part, Scene, compose

from .blade import Blade
from .bodies import Degrees, turned
from .dragonfly import Seat, dragonfly_on
from .leaf import (
    Bend,
    Curl,
    LeafLength,
    LeafWidth,
    Seed,
    Thickness,
    Undulation,
    blade_of,
    surface_of,
)

MOST_ALONG, MOST_ACROSS = 0.06, 0.03
"""Largest distance of the dragonfly from the leaf's middle, m."""
TRIES = 1000

Along = Annotated[float, Field(ge=-MOST_ALONG, le=MOST_ALONG)]
Across = Annotated[float, Field(ge=-MOST_ACROSS, le=MOST_ACROSS)]
BodyLength = Annotated[float, Field(ge=0.03, le=0.08)]


def leaf_dragonfly(
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
    dragonfly: MaterialName = "insect",
    body_length: BodyLength = 0.05,
    along: Along = 0.0,
    across: Across = 0.0,
    heading: Degrees = 0.0,
    placement_seed: Seed | None = None,
) -> Scene:
    """Build the scene `leaf` of the same options, and a dragonfly of a material that sits on it.

    Along and across (m) is where the middle of its body is, from the leaf's; heading (degrees) is
    about the leaf's normal, 0 to the tip. A placement seed draws all three.
    """
    blade = blade_of(seed, length, width, curl, bend, thickness, undulation)
    if placement_seed is None:
        seat = Seat(blade, along, across, float(np.radians(heading)), body_length)
        if not seat.holds():
            raise SettingsError(
                f"scene.options.along: found {along:g}, across {across:g} and heading {heading:g}, "
                "where body or feet reach past the leaf's edge; move it towards the middle, turn "
                "it, or lower body_length"
            )
    else:
        seat = _drawn(blade, body_length, placement_seed)
    parts = [
        Part(Scene(turned(mesh, yaw, pitch, roll), MATERIALS[of]))
        for mesh, of in ((surface_of(blade), material), (dragonfly_on(seat), dragonfly))
    ]
    return compose(parts, may_cross=True)  # its feet touch the leaf


def _drawn(blade: Blade, body_length: float, placement_seed: int) -> Seat:
    """Draw where it sits, uniformly over all places on the leaf within the bounds."""
    random = np.random.default_rng([placement_seed, 1])
    for _ in range(TRIES):
        along = random.uniform(-MOST_ALONG, MOST_ALONG)
        across = random.uniform(-MOST_ACROSS, MOST_ACROSS)
        seat = Seat(blade, along, across, random.uniform(-np.pi, np.pi), body_length)
        if seat.holds():
            return seat
    raise SettingsError(
        f"scene.options.body_length: found {body_length:g}; there is no room for it on the leaf; "
        "lower it, or raise length and width"
    )
