# SPDX-License-Identifier: MIT
"""Errors of a recording."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal, get_args

import numpy as np

from sononerf.array_types import Floats

Kind = Literal["gain", "range_offset", "speed_of_sound", "support"]
KINDS: tuple[Kind, ...] = get_args(Kind)


@dataclass(eq=False)
class Calibration:
    """Errors of a recording; zero where nothing is wrong.

    Attributes:
        gain (E,): Natural logarithm of how much too loud each receiver is.
        range_offset (m): Excess of all measured ranges.
        speed_of_sound: Logarithm of the true speed over the assumed one.
    """

    gain: Floats
    range_offset: float = 0.0
    speed_of_sound: float = 0.0

    @classmethod
    def none(cls, receivers: int) -> Calibration:
        """Return no errors."""
        return cls(np.zeros(receivers))


@dataclass(frozen=True, eq=False)
class Estimate:
    """Estimated errors of a recording and their uncertainties.

    Attributes:
        calibration: The errors.
        deviation: One standard deviation of each kind, in its own unit.
        error_db: Mean absolute difference over active cells before each step, and after the last.
    """

    calibration: Calibration
    deviation: dict[str, float]
    error_db: list[float]
