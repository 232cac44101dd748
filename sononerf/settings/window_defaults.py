# SPDX-License-Identifier: MIT
"""Window, hop and FFT of an analysis that follow from its band where they are not set."""

from __future__ import annotations

import math
from typing import Any


def window_of(analysis: dict[str, Any]) -> int:
    """Return the power of two, in samples, that is nearest to 6.4 periods of the highest frequency.

    It gives 64 at 1 MHz for up to 100 kHz.
    """
    if not {"sampling_rate", "frequency_max"} <= analysis.keys():  # told as a fault of its own
        return 64
    periods = 6.4 * analysis["sampling_rate"] / analysis["frequency_max"]
    return int(2 ** max(round(math.log2(periods)), 3))


def hop_of(analysis: dict[str, Any]) -> int:
    """Return a sixteenth of the window that suits the band, in samples."""
    return max(window_of(analysis) // 16, 1)


def fft_of(analysis: dict[str, Any]) -> int:
    """Return eight times the window that suits the band, and more if a longer one is set."""
    longest = max(8 * window_of(analysis), analysis.get("window", 8))
    return int(2 ** math.ceil(math.log2(longest)))
