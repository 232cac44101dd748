# SPDX-License-Identifier: MIT
"""A helix of round wire: thin, bent everywhere, and in front of itself from every side."""

from __future__ import annotations

import math
from typing import Annotated

import numpy as np
from pydantic import Field

from sononerf.errors import SettingsError
from sononerf.scene import MATERIALS, MaterialName, Scene

from .bodies import SIDE, Degrees, Length, Radius, Wire, placed
from .loft import loft

Turns = Annotated[float, Field(ge=0.5, le=20)]


def helix(
    radius: Radius = 0.03,
    pitch_length: Length = 0.025,
    turns: Turns = 4.0,
    wire_radius: Wire = 0.003,
    yaw: Degrees = 0.0,
    pitch: Degrees = 0.0,
    roll: Degrees = 0.0,
    material: MaterialName = "rigid",
) -> Scene:
    """Build an upright, right-handed helix of wire with round ends: lengths in m.

    The radius is that of the wire's middle line, the pitch length the height of one turn. The helix
    is turned by yaw, pitch and roll (degrees).
    """
    around = 2.0 * math.pi * radius
    slope = math.hypot(around, pitch_length)
    # Neighbouring turns are nearest to one another at a right angle to the wire.
    limit, why = min(
        (pitch_length * around / slope / 2.0, "neighbouring turns would touch"),
        (radius, "the wire would fill the middle"),
    )
    if wire_radius >= limit:
        raise SettingsError(
            f"scene.options.wire_radius: found {wire_radius:g}; must lie below {limit:.3g}, "
            f"else {why}"
        )
    # The outside of the bend is longer than the middle line.
    count = max(8, math.ceil(turns * slope * (1.0 + wire_radius / radius) / SIDE))
    share = np.linspace(0.0, turns, count + 1)
    angle = 2.0 * np.pi * share
    path = np.stack([radius * np.cos(angle), radius * np.sin(angle), pitch_length * share], axis=1)
    along = np.stack(
        [-around * np.sin(angle), around * np.cos(angle), np.full_like(angle, pitch_length)], axis=1
    )
    start, end = along[[0, -1]] / slope
    # The ends are half spheres: circles that shrink as they move on.
    caps = max(3, math.ceil(0.5 * math.pi * wire_radius / SIDE))
    cap = 0.5 * np.pi * np.arange(1, caps + 1)[:, None] / caps
    before = path[0] - wire_radius * np.sin(cap[::-1]) * start
    behind = path[-1] + wire_radius * np.sin(cap) * end
    shrunk = wire_radius * np.cos(cap[:, 0])
    widths = np.concatenate((shrunk[::-1], np.full(count + 1, wire_radius), shrunk))
    mesh = loft(np.concatenate((before, path, behind)), widths)
    return Scene(placed(mesh, yaw, pitch, roll), MATERIALS[material])
