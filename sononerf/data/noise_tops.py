# SPDX-License-Identifier: MIT
"""How loud the noise of a pose gets, told from what it heard alone."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

NOISE_DB, QUIET_SHARE = 10.0, 0.1
"""Above the quietest tenth of what a pose heard: so high do the tops of noise reach. Of a hundred
thousand ranges of noise none is louder."""
EVEN_SHARES = (0.05, 0.25)
"""What is quiet is noise where these quantiles lie close together: noise is about as loud at all
ranges, while echoes fade."""


def noise_tops(
    power: NDArray[np.floating], even_db: float
) -> tuple[NDArray[np.float64], NDArray[np.bool_]]:
    """Return what no noise reaches, and whether there is noise at all.

    Parameters
    ----------
    power : (..., R) float
        What was heard, over range.
    even_db : float
        How far apart the quantiles of noise lie at most; the more cells were added up for each
        range, the closer.

    Returns
    -------
    tops : (...) float
        Power, to be trusted where there is noise; elsewhere some way above the quietest ranges.
    noisy : (...) bool
        Whether what is quiet is noise.
    """
    tops = np.quantile(power, QUIET_SHARE, axis=-1) * 10 ** (NOISE_DB / 10)
    low, high = np.quantile(power, EVEN_SHARES, axis=-1)
    return np.asarray(tops), np.asarray(high < low * 10 ** (even_db / 10))
