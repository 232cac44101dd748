# SPDX-License-Identifier: MIT
"""The lag of poses behind pings, found from first echoes alone.

A camera and a recorder seldom have one clock. If each ping belongs to a place a little further on
the flight, the first echoes fit the poses best when these are interpolated there. No surface is
needed: each ping is predicted from the others (``pose_check``).
"""

from __future__ import annotations

import math
from collections.abc import Callable

import numpy as np
from scipy.spatial.transform import Rotation, Slerp

from sononerf.array_types import Floats, Ints
from sononerf.geometry.poses import Poses
from sononerf.recordings.pose_check import Consistency

MOST_ROWS = 4.0
"""Largest lag that is searched, rows. The check of an import names
a table that is off by whole rows, so that larger lags are rare."""
STEP = 0.2
"""Spacing of the lags that are tried, rows; between them the likelihood is weighted."""
LAGS = np.arange(-MOST_ROWS, MOST_ROWS + STEP / 2.0, STEP)
INDEPENDENT = 25.0
"""Number of errors, at most, that count as independent, no unit: the number of coefficients of the
model of the body. Errors of that model are alike at all pings from one side. With this number, 24
flights of 90 to 300 pings around random bodies were off by 0.7 standard deviations, root mean
square, and by 1.8 at most."""
PATH = 0.5
"""Largest median distance of successive poses over that of random pairs, no unit, at which they
count as a path. Poses in random order reach 1."""


def is_path(poses: Poses) -> bool:
    """Return whether successive poses are neighbours, so that places between them can be known."""
    steps = np.linalg.norm(np.diff(poses.positions, axis=0), axis=1)
    order = np.random.default_rng(0).permutation(len(poses))
    apart = np.linalg.norm(np.diff(poses.positions[order], axis=0), axis=1)
    return bool(np.median(steps) < PATH * np.median(apart))


def later(poses: Poses, rows: float) -> Poses:
    """Return the poses some rows later on their path, between two rows too; the ends stay."""
    numbers = np.arange(len(poses))
    at = (numbers + rows).clip(0, len(poses) - 1)
    first = np.minimum(at.astype(int), len(poses) - 2)
    part = (at - first)[:, None]
    positions = (1.0 - part) * poses.positions[first] + part * poses.positions[first + 1]
    turned = Slerp(numbers, Rotation.from_matrix(poses.rotations))(at)
    return Poses(positions, turned.as_matrix())


def find_lag(
    poses: Poses,
    first: Floats,
    heard: Ints,
    consistency: Consistency,
    shown: Callable[[], None] = lambda: None,
) -> tuple[float, float]:
    """Return the lag of pings behind their poses, rows, and its standard deviation.

    Args:
        first ((N, E), m): Ranges of the first echoes of some pings; not finite without an echo.
        heard (N,): Rows of these pings.
    """
    misfits = []
    for lag in LAGS.tolist():
        misfits.append(consistency.misfit(later(poses, lag)[heard], first))
        shown()
    errors = np.array([one.total for one in misfits])
    shared = max(misfits[0].count / INDEPENDENT, 1.0)
    chance = np.exp(-(errors - errors.min()) / shared)
    lag = float(np.average(LAGS, weights=chance))
    spread = float(np.average((LAGS - lag) ** 2, weights=chance))
    return lag, math.hypot(math.sqrt(spread), STEP / math.sqrt(12.0))
