# SPDX-License-Identifier: MIT
"""Intervals around predicted levels that hold 90 % of the measured ones.

By split conformal prediction [1]_: the quantile of the absolute errors on validation poses, in
classes of the predicted level and of the frequency. It holds for poses drawn like these.

References:
    .. [1] J. Lei et al., "Distribution-free predictive inference for regression", JASA 113, 2018.
"""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import ArrayLike

from sononerf.array_types import Floats, Ints
from sononerf.head.decibels import RANGE_DB

COVERED = 0.9
"""Fraction of the active cells that an interval holds."""
STEP_DB = 6.0
"""Width of a class of predicted levels, dB: a factor of two in magnitude."""
CLASSES = round(RANGE_DB / STEP_DB)
BANDS = 6
"""Number of classes of frequency: with ten poses each class holds some hundred cells."""
FEWEST = 50
"""Number of active cells below which a class takes the quantile of its level at all frequencies."""


def learn_interval(
    measured_db: ArrayLike, predicted_db: ArrayLike, active_db: float | Floats
) -> Floats:
    """Return half the width of the interval by class.

    In: measured_db, predicted_db ((P, E, R, F), dB), active_db (dB). Out: half_db ((CLASSES, F),
    dB).
    """
    measured, predicted = (np.asarray(a, dtype=np.float64) for a in (measured_db, predicted_db))
    error = np.abs(measured - predicted)
    active = (measured >= active_db) | (predicted >= active_db)
    level, count = level_class(predicted), predicted.shape[-1]
    half = np.full((CLASSES, count), RANGE_DB)  # nothing is known
    known = [one for one in range(CLASSES) if (active & (level == one)).any()]
    for one in known:
        some = active & (level == one)
        usual = _quantile(error[some])
        for band in np.array_split(np.arange(count), min(BANDS, count)):
            found = error[..., band][some[..., band]]
            half[one, band] = usual if len(found) < FEWEST else _quantile(found)
    for one in range(CLASSES) if known else ():  # others are as uncertain as the next lower one
        half[one] = half[max((other for other in known if other <= one), default=known[0])]
    return half


def interval_db(predicted_db: ArrayLike, half_db: Floats) -> Floats:
    """Return half the width of the interval of each cell, dB.

    In: predicted_db ((..., F), dB), half_db ((CLASSES, F), dB).
    """
    level = level_class(predicted_db)
    found: Floats = half_db[level, np.arange(level.shape[-1])]
    return found


def level_class(predicted_db: ArrayLike) -> Ints:
    """Return the class of predicted levels, 0 to ``CLASSES`` - 1."""
    found: Ints = (np.asarray(predicted_db) / STEP_DB).astype(np.int64).clip(0, CLASSES - 1)
    return found


def _quantile(errors: Floats) -> float:
    """Return the error that a new one exceeds with a probability of 1 - ``COVERED`` at most."""
    rank = min(math.ceil((len(errors) + 1) * COVERED), len(errors))
    return float(np.partition(errors, rank - 1)[rank - 1])


def covered(
    measured_db: ArrayLike, predicted_db: ArrayLike, half_db: ArrayLike, active_db: float | Floats
) -> float | None:
    """Return the fraction of the active cells whose measured level lies within the interval.

    In: measured_db, predicted_db ((P, E, R, F), dB), half_db ((P, E, R, F), dB), active_db (dB).
    """
    measured, predicted = (np.asarray(a, dtype=np.float64) for a in (measured_db, predicted_db))
    active = (measured >= active_db) | (predicted >= active_db)
    within = (np.abs(measured - predicted) <= half_db)[active]
    return float(within.mean()) if len(within) else None
