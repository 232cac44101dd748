# SPDX-License-Identifier: MIT
"""The echo of one point in a spectrogram: its power over range, and the range resolution."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from sononerf.head.call import covered
from sononerf.head.reception import effective_window
from sononerf.head.row_filters import band_mean, band_parts, row_filters
from sononerf.settings.schema import CallSettings, SpectrogramSettings

Array = NDArray[np.float64]


@dataclass(frozen=True, eq=False)
class PointEcho:
    """What the analysis makes of the echo of one point.

    Attributes:
        window (W,): Its power over range, averaged over the part of the band that the call has.
        spacing (m): Between these values.
        looks: How many independent values there are among the frequencies.
        rows ((F, W) or None): The same of each row, which the window is the sum of; None where all
            rows are about alike. If low rows swell more slowly, an echo without high frequencies
            does so too.
    """

    window: Array
    spacing: float
    looks: float
    rows: Array | None = None

    @classmethod
    def of(
        cls, call: CallSettings, analysis: SpectrogramSettings, speed_of_sound: float
    ) -> PointEcho:
        """Return the echo of a call (m/s) in an analysis."""
        rows = effective_window(call, analysis)
        filters = row_filters(analysis)
        swept = covered(call, filters.frequency)
        kept = swept if swept.any() else np.arange(len(rows)) < 1
        part = band_parts(filters.frequency)
        return cls(
            window=band_mean((rows[kept] ** 2).T, filters.frequency[kept]),
            rows=None if part is None else rows**2 * (part * kept)[:, None],
            spacing=speed_of_sound / 2.0 / analysis.sampling_rate,
            looks=filters.looks,
        )

    def of_spectrum(self, magnitude: NDArray[np.floating]) -> Array:
        """Return the window (W,) of an echo whose rows have some magnitudes (F,)."""
        assert self.rows is not None
        return np.asarray(np.square(magnitude, dtype=np.float64) @ self.rows)

    @property
    def resolution(self) -> float:
        """Width in range over which its magnitude is above half of its greatest, m.

        What lies apart from its own range, as another harmonic's echo does, is not counted.
        """
        top = own_top(self.window)
        low = np.flatnonzero(self.window < 0.25 * self.window[top])
        first = int(low[low < top].max(initial=-1)) + 1
        last = int(low[low > top].min(initial=len(self.window))) - 1
        return float(last - first + 1) * self.spacing


def own_top(window: Array) -> int:
    """Return where a point echo (W,) is greatest about its own range, which is in the middle.

    What lies apart from that, as another harmonic's echo does, may be greater.
    """
    top = (len(window) - 1) // 2
    while 0 < top < len(window) - 1:
        beside = top + (1 if window[top + 1] > window[top - 1] else -1)
        if window[beside] <= window[top]:
            break
        top = beside
    return top
