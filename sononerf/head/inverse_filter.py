# SPDX-License-Identifier: MIT
r"""Pulse compression by the inverse of the call's spectrum.

A recording :math:`x` of a call :math:`p` becomes what an impulse would have been answered by,

.. math:: Y(f) = \frac{X(f)\,P^*(f)}{\max(|P(f)|^2, \epsilon \max |P|^2)}

so the range resolution is that of the band, however long the call was. Within 20 dB of the call's
loudest frequency the division is exact; the rest of the band stays faint, so noise does not grow.
"""

from __future__ import annotations

import numpy as np
import scipy.fft
from numpy.typing import ArrayLike, NDArray

EPSILON = 0.01
"""Power spectrum of the call, over its greatest, below which the division is not exact: 20 dB, as
far as a call counts as covering a frequency."""


def inverse_filter(recordings: ArrayLike, call: ArrayLike) -> NDArray[np.float64]:
    """Replace each echo of a call by that of an impulse.

    Parameters
    ----------
    recordings : (..., S) float
        From the start of the emission on.
    call : (N,) float
        Waveform, at the same sampling rate.

    Returns
    -------
    compressed : (..., S) float64
        An echo that is ``g`` times the call has the spectrum ``g`` within the call's band. The last
        N - 1 samples lack what came after the recording.

    Raises
    ------
    ValueError
        If the call is silent or has several dimensions.
    """
    heard, waveform = (np.asarray(each, dtype=np.float64) for each in (recordings, call))
    if waveform.ndim != 1 or not np.any(waveform):
        raise ValueError(f"call: shape {waveform.shape}, expected (N,) and not silent")
    samples = heard.shape[-1]
    # Side lobes of the inverse ring over more than the call; they must not wrap around.
    length = int(scipy.fft.next_fast_len(samples + 2 * len(waveform), real=True))
    spectrum = np.fft.rfft(waveform, length)
    power = np.abs(spectrum) ** 2
    inverse = spectrum.conj() / np.maximum(power, EPSILON * power.max())
    compressed: NDArray[np.float64] = np.fft.irfft(np.fft.rfft(heard, length) * inverse, length)
    return compressed[..., :samples]
