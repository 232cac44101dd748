# SPDX-License-Identifier: MIT
r"""Pulse compression with phase, for comparison: what an ear without phase has to do without.

The recording is correlated with the call that was emitted,

.. math:: y(t) = \frac{\sum_n x(t + n) \, p(n)}{\sum_n p(n)^2}

which of all linear filters makes an echo in white noise stand out best [1]_. Its analytic signal
has the echo's envelope as magnitude and its phase as phase.

References:
    .. [1] G. L. Turin, "An introduction to matched filters", IRE Transactions on Information Theory
       6(3), 1960.
"""

from __future__ import annotations

import numpy as np
import scipy.fft
from numpy.typing import ArrayLike, NDArray


def matched_filter(
    recordings: ArrayLike, call: ArrayLike, *, oversampling: int = 1
) -> NDArray[np.complex128]:
    """Compress the echoes of a call.

    Args:
        recordings (..., S): Pressure from the start of the emission on.
        call (N,): Waveform, at the same sampling rate.
        oversampling: Samples of the result per sample of the recordings.

    Returns:
        compressed ((..., S * oversampling) complex128): Analytic signal. An echo that is ``g``
            times the call has the magnitude ``g`` at its delay; the magnitude is the envelope, the
            real part the filter's output.

    Raises:
        ValueError: If the call is silent or has several dimensions, or the oversampling is below 1.

    Examples:
        >>> call = np.sin(np.arange(60.0) ** 2 / 60.0)
        >>> echo = np.zeros(300)
        >>> echo[100:160] = 0.5 * call
        >>> compressed = matched_filter(echo, call)
        >>> int(abs(compressed).argmax()), round(float(compressed[100].real), 6)
        (100, 0.5)
    """
    heard, waveform = (np.asarray(each, dtype=np.float64) for each in (recordings, call))
    if waveform.ndim != 1 or not np.any(waveform):
        raise ValueError(f"call: shape {waveform.shape}, expected (N,) and not silent")
    if oversampling < 1:
        raise ValueError(f"oversampling is {oversampling}, expected 1 or more")
    samples = heard.shape[-1]
    length = int(scipy.fft.next_fast_len(samples + len(waveform)))
    spectrum = np.fft.fft(heard, length) * np.fft.fft(waveform, length).conj()
    half = (length + 1) // 2
    one_sided = np.zeros((*spectrum.shape[:-1], length * oversampling), dtype=np.complex128)
    one_sided[..., :half] = 2.0 * spectrum[..., :half]
    one_sided[..., 0] /= 2.0
    if length % 2 == 0:  # half the sampling rate is a cosine's frequency and a sine's
        one_sided[..., half] = spectrum[..., half]
    scale = oversampling / (waveform**2).sum()
    compressed: NDArray[np.complex128] = np.fft.ifft(one_sided)[..., : samples * oversampling]
    return compressed * scale


EPSILON = 0.01
"""Power spectrum of the call, over its greatest, below which the division is not exact: 20 dB, as
far as a call counts as covering a frequency."""


def inverse_filter(recordings: ArrayLike, call: ArrayLike) -> NDArray[np.float64]:
    """Replace each echo of a call by that of an impulse.

    Args:
        recordings (..., S): From the start of the emission on.
        call (N,): Waveform, at the same sampling rate.

    Returns:
        compressed (..., S): An echo that is ``g`` times the call has the spectrum ``g`` within the
            call's band. The last N - 1 samples lack what came after the recording.

    Raises:
        ValueError: If the call is silent or has several dimensions.
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
