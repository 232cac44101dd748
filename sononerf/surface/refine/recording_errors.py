# SPDX-License-Identifier: MIT
"""Errors of a recording."""

from __future__ import annotations

import dataclasses
from dataclasses import dataclass
from typing import Literal, get_args

import numpy as np

from sononerf.array_types import Floats
from sononerf.head.head import Head

Kind = Literal[
    "gain",
    "range_offset",
    "speed_of_sound",
    "radius",
    "support",
    "beam_radius",
    "position",
    "aim",
]
KINDS: tuple[Kind, ...] = get_args(Kind)


@dataclass(frozen=True, eq=False)
class Calibration:
    """Errors of a recording; zero where nothing is wrong.

    Attributes:
        gain (E,): Natural logarithm of how much too loud each receiver is.
        range_offset (m): Excess of all measured ranges.
        speed_of_sound: Logarithm of the true speed over the assumed one.
        radius (m): To be added to the distance of the poses from the turntable's axis.
        beam_radius (m): To be added to the radius of the emitter.
        position ((P, 3), m): To be added to the stated positions.
        aim ((P, 3), rad): Rotation vectors, world frame, to be applied to the stated rotations.
    """

    gain: Floats
    range_offset: float
    speed_of_sound: float
    position: Floats
    aim: Floats
    radius: float = 0.0
    beam_radius: float = 0.0

    @classmethod
    def none(cls, receivers: int, poses: int) -> Calibration:
        """Return no errors."""
        return cls(np.zeros(receivers), 0.0, 0.0, np.zeros((poses, 3)), np.zeros((poses, 3)))


@dataclass(frozen=True, eq=False)
class Estimate:
    """Estimated errors of a recording and their uncertainties.

    Attributes:
        calibration: The errors.
        deviation: One standard deviation of each kind: shared errors in their own unit; position
            (m) and aim (rad) as the root mean square over poses and axes.
        error_db: Mean absolute difference over active cells before each step, and after the last.
    """

    calibration: Calibration
    deviation: dict[str, float]
    error_db: list[float]


def outward(positions: Floats) -> Floats:
    """Return the directions from the z axis to places (P, 3), m, as unit vectors (P, 3)."""
    away = positions * np.array([1.0, 1.0, 0.0])
    return away / np.maximum(np.linalg.norm(away, axis=1, keepdims=True), 1e-12)


def changed_head(head: Head, *, support: float = 0.0, beam_radius: float = 0.0) -> Head:
    """Return a head whose support is higher (m, along its normal), and its emitter larger (m)."""
    plane, ears = head.plane, head.ears
    standing = head.support
    if plane is not None:
        point = np.asarray(plane.point) + support * np.asarray(plane.normal)
        standing = standing.model_copy(update={"point": tuple(point.tolist())})
    if beam_radius:
        ears = ears.model_copy(update={"beam_radius": max(ears.beam_radius + beam_radius, 0.0)})
    return dataclasses.replace(head, ears=ears, support=standing)
