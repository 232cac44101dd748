# SPDX-License-Identifier: MIT
"""Between which ranges the echoes of an ensemble lie."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from sononerf.echoes.detection import threshold_levels

Array = NDArray[np.float64]

FEW = 0.02
"""Fraction of the poses that must hear an echo at a range or beyond it for it to count, no unit."""


def echo_extent(power: Array, axis: Array, looks: float, margin: float) -> tuple[float, float]:
    """Return the least and the greatest range (m) that hold echoes, with a margin.

    Parameters
    ----------
    power : (P, E, R) float
        Power averaged over frequency.
    axis : (R,) float, m
        Ranges of the slices.
    looks : float
        How many independent values each power is the average of.
    margin : float, m
        Added on both sides.

    Returns
    -------
    limits : (float, float), m
        Within the axis; all of it where nothing is heard.
    """
    loud: NDArray[np.bool_] = power > threshold_levels(power, looks).total
    heard = np.asarray(loud.any(axis=1))  # (P, R)
    some = np.asarray(heard.any(axis=1))
    if not some.any():
        return float(axis[0]), float(axis[-1])
    first = axis[heard[some].argmax(axis=1)]
    last = axis[heard.shape[1] - 1 - heard[some, ::-1].argmax(axis=1)]
    low, high = np.quantile(first, FEW), np.quantile(last, 1.0 - FEW)
    return max(float(low - margin), float(axis[0])), min(float(high + margin), float(axis[-1]))
