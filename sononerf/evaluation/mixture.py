# SPDX-License-Identifier: MIT
"""Combine two predictions: the field's rendering and the echoes of the surface.

The field predicts power and knows no interference and no later bounces. The echoes of the surface
have both, as far as the surface is right. One regression per frequency on the validation poses
weighs them. Held-out poses take no part.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike, NDArray

Array = NDArray[np.float64]
LOUD_DB = 20.0
"""Cells above this level, in reported decibels, give the gain: fainter ones hold the window's side
lobes and interference."""


def gain_db(measured_db: ArrayLike, traced_db: ArrayLike) -> Array:
    """Return how much louder each ear measured each frequency than it was traced.

    Parameters
    ----------
    measured_db, traced_db : (P, E, R, F) float, dB
        Reported decibels; 0 dB is silence.

    Returns
    -------
    gain : (E, F) float, dB
        Median over the cells above ``LOUD_DB`` in both; zero where there is none.
    """
    measured, traced = (np.asarray(a, dtype=np.float64) for a in (measured_db, traced_db))
    loud = (measured > LOUD_DB) & (traced > LOUD_DB)
    apart = measured - traced
    ears, rows = measured.shape[1], measured.shape[3]
    gain = np.zeros((ears, rows))
    for ear, row in np.ndindex(ears, rows):
        some = loud[:, ear, :, row]
        if some.any():
            gain[ear, row] = np.median(apart[:, ear, :, row][some])
    return gain


def mix(rendered_db: ArrayLike, traced_db: ArrayLike, weight: ArrayLike) -> Array:
    """Return the weighted mean of two predictions in decibels.

    Parameters
    ----------
    rendered_db, traced_db : (..., F) float, dB
        Predictions.
    weight : (F,) float
        Weight of the traced one, 0 to 1.

    Returns
    -------
    mixed_db : (..., F) float64, dB
    """
    first = np.asarray(rendered_db, dtype=np.float64)
    return first + np.asarray(weight) * (np.asarray(traced_db, dtype=np.float64) - first)


def regress_weight(measured_db: ArrayLike, rendered_db: ArrayLike, traced_db: ArrayLike) -> Array:
    r"""Return the weight of the traced prediction that minimises the error per frequency.

    The weight minimises :math:`\sum |m - r - w (t - r)|` with :math:`0 \le w \le 1` over all
    cells of a frequency: least absolute deviations, as the reported error is. With one unknown the
    solution is the median of :math:`(m - r) / (t - r)`, weighted by :math:`|t - r|`.

    Parameters
    ----------
    measured_db, rendered_db, traced_db : (..., F) float, dB
        Of poses that neither prediction was fitted to.

    Returns
    -------
    weight : (F,) float
        0 to 1; zero where both predictions are equal.
    """
    measured, rendered, traced = (
        np.asarray(a, dtype=np.float64) for a in (measured_db, rendered_db, traced_db)
    )
    count = measured.shape[-1]
    wanted = (measured - rendered).reshape(-1, count)
    apart = (traced - rendered).reshape(-1, count)
    weights = np.zeros(count)
    for row in range(count):
        known = np.abs(apart[:, row]) > 0
        if known.any():
            slope = wanted[known, row] / apart[known, row]
            weights[row] = _weighted_median(slope, np.abs(apart[known, row]))
    return weights.clip(0.0, 1.0)


def _weighted_median(values: Array, weights: Array) -> float:
    order = values.argsort(kind="stable")
    total = weights[order].cumsum()
    return float(values[order][np.searchsorted(total, 0.5 * total[-1])])
