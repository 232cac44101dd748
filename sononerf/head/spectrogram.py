# SPDX-License-Identifier: MIT
"""From echo to spectrogram: short filters over range, dechirp, magnitude, compression."""

from __future__ import annotations

import math

import numpy as np
import scipy.fft
from numpy.lib.stride_tricks import sliding_window_view
from numpy.typing import ArrayLike, NDArray

from sononerf.head.row_filters import fft_bins, row_filters, row_frequencies
from sononerf.settings.schema import SpectrogramSettings


def frequency_axis(settings: SpectrogramSettings) -> NDArray[np.float64]:
    """Frequencies of the rows, see :mod:`sononerf.head.row_filters`.

    Of the kind ``stft`` the FFT's bins nearest to the two ends, and all between,
    ``sampling_rate / fft`` apart; of ``gammatone`` equal ratios from one end to the other.

    Args:
        settings: The analysis.

    Returns:
        frequency ((F,), Hz): Ascending.

    Examples:
        >>> axis = frequency_axis(SpectrogramSettings())
        >>> len(axis), float(axis[0]), float(axis[-1])
        (47, 9765.625, 99609.375)
    """
    return row_frequencies(settings)


def range_axis(settings: SpectrogramSettings, speed_of_sound: float) -> NDArray[np.float64]:
    """Ranges of the analysis frames, ``c t / 2`` with t at the centre of the frame's envelopes.

    Args:
        settings: The analysis; frames start every ``hop`` samples from the emission on.
        speed_of_sound (m/s): Of the medium.

    Returns:
        range ((R,), m): Those within ``range_min`` to ``range_max``.

    Examples:
        >>> len(range_axis(SpectrogramSettings(), 343.0))
        875
    """
    first, last = _frames(settings, speed_of_sound)
    frames = np.arange(first, last + 1, dtype=np.float64)
    centre = frames * settings.hop + row_filters(settings).centre
    return centre * (speed_of_sound / 2.0 / settings.sampling_rate)


def _frames(settings: SpectrogramSettings, speed_of_sound: float) -> tuple[int, int]:
    samples_per_metre = 2.0 * settings.sampling_rate / speed_of_sound
    centre = row_filters(settings).centre
    first = math.ceil((settings.range_min * samples_per_metre - centre) / settings.hop)
    last = math.floor((settings.range_max * samples_per_metre - centre) / settings.hop)
    first = max(first, 0)
    if last < first:
        raise ValueError(
            f"no analysis frame lies between range_min {settings.range_min} m and range_max "
            f"{settings.range_max} m; widen them, or shorten window and hop"
        )
    return first, last


def echo_samples(
    settings: SpectrogramSettings, speed_of_sound: float, longest_delay: float = 0.0
) -> int:
    """How many samples from the emission on the last analysis frame needs.

    Args:
        settings: The analysis.
        speed_of_sound (m/s): Of the medium.
        longest_delay (s): The greatest by which a frequency's row is advanced; 0 for an impulse.

    Returns:
        samples: At the sampling rate of the settings.
    """
    last = _frames(settings, speed_of_sound)[1]
    reach = row_filters(settings).reach
    return last * settings.hop + reach + math.ceil(longest_delay * settings.sampling_rate)


def spectrogram(
    echo: ArrayLike,
    settings: SpectrogramSettings,
    speed_of_sound: float,
    delay: ArrayLike | None = None,
) -> NDArray[np.float64]:
    r"""Magnitude in the rows' filters on the range and frequency axes, dechirped.

    Of the kind ``stft`` that is the short-time Fourier transform with a symmetric Hamming window,
    unnormalised. A sweep emits each frequency at a time :math:`\tau(f)` of its own; its row is
    advanced by exactly that [1]_,

    .. math:: S(r, f) = \left| X\left(\tfrac{2 r}{c} + \tau(f), f\right) \right|

    with :math:`X(t, f)` the output of the filter whose envelope is centred at :math:`t`, between
    two samples too.

    Args:
        echo (E, S): Pressure from the emission on, at the sampling rate of the settings.
        settings: The analysis.
        speed_of_sound (m/s): Of the medium.
        delay ((F,), s): Emission time of each frequency, zero or more; all at once where it is left
            out.

    Returns:
        magnitude (E, R, F): Linear.

    Raises:
        ValueError: If the echo ends before the last frame, or a delay is negative.

    References:
        .. [1] W. Jansen and J. Steckel, SonoNERFs, Biomimetics 9(6):321, 2024, equation (16).
    """
    signal = np.asarray(echo, dtype=np.float64)
    advance = np.zeros(1) if delay is None else np.asarray(delay, dtype=np.float64)
    if not (advance >= 0.0).all():
        raise ValueError("a delay is negative; a frequency is emitted at time 0 or later")
    needed = echo_samples(settings, speed_of_sound, float(advance.max()))
    if signal.shape[-1] < needed:
        raise ValueError(
            f"the echo has {signal.shape[-1]} samples, the last frame needs {needed}; "
            "record longer or lower range_max"
        )
    first, last = _frames(settings, speed_of_sound)
    starts = slice(first * settings.hop, last * settings.hop + 1, settings.hop)
    if advance.any() or settings.kind != "stft":
        return _filtered(signal, settings, starts, advance)
    frames = sliding_window_view(signal, settings.window, axis=-1)[..., starts, :]
    low, high = fft_bins(settings)
    spectrum = np.fft.rfft(frames * np.hamming(settings.window), n=settings.fft, axis=-1)
    magnitude: NDArray[np.float64] = np.abs(spectrum[..., low : high + 1])
    return magnitude


def _filtered(
    signal: NDArray[np.float64],
    settings: SpectrogramSettings,
    starts: slice,
    delay: NDArray[np.float64],
) -> NDArray[np.float64]:
    """Each frequency's row as a filter, an envelope on that frequency; a delay is then a phase."""
    filters = row_filters(settings)
    delays = np.broadcast_to(delay, filters.frequency.shape)
    # What a filter reads before the emission is the silence behind the signal's end.
    length = int(scipy.fft.next_fast_len(signal.shape[-1] - filters.origin))
    spectrum = np.fft.fft(signal, length)
    turn = 2j * np.pi * np.fft.fftfreq(length)
    sample = np.arange(filters.envelope.shape[1]) / settings.sampling_rate
    rows = []
    for frequency, envelope, advance in zip(
        filters.frequency, filters.envelope, delays, strict=True
    ):
        kernel = np.fft.fft(envelope * np.exp(2j * np.pi * frequency * sample), length)
        phase = np.exp(turn * (advance * settings.sampling_rate + filters.origin))
        rows.append(np.abs(np.fft.ifft(spectrum * kernel.conj() * phase)[..., starts]))
    return np.stack(rows, axis=-1)
