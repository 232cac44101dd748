# SPDX-License-Identifier: MIT
r"""The front end: one complex filter per row of a spectrogram.

A row at frequency :math:`f` is the magnitude of the echo under a real envelope :math:`w_f` that
rides on a tone,

.. math:: S(t, f) = \left| \sum_n x[n] \, w_f[n - t] \, e^{-2 \pi j f n} \right|

so that an impulse gives the envelope reversed in time, with its greatest value at range 0 offset.

``stft``
    One symmetric Hamming window for all rows, at the frequencies of an FFT's bins.
``gammatone``
    The reversed envelope of a gammatone filter of order 4 [1]_,
    :math:`t^3 e^{-2 \pi b t}` with :math:`b = 1.019 f / Q`, advanced by the time of its peak,
    :math:`3 / (2 \pi b)`. The equivalent rectangular bandwidth is :math:`f / Q`, so equal steps on
    the axis of bandwidths are equal ratios of frequency [2]_. Low rows last longer than high ones.

Where rows are averaged, each counts with its part of the band in hertz (:func:`band_mean`), as FFT
bins do: an echo then lasts as its upper channels have it, which tell its range best. Where one
length is needed for all rows, it is that of the Hamming window that is as wide (-6 dB) as the root
mean square of the rows' envelopes, averaged so.

References:
    .. [1] R. D. Patterson et al., "Complex sounds and auditory images", Auditory Physiology and
       Perception, 1992.
    .. [2] B. R. Glasberg and B. C. J. Moore, "Derivation of auditory filter shapes from
       notched-noise data", Hearing Research 47, 1990; here without the constant part of the
       bandwidth, which is 25 Hz in man.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import lru_cache
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from sononerf.numerics import Floats
from sononerf.settings.schema import SpectrogramSettings

WINDOW_DURATION = 0.528  # of a Hamming window's length, where it is above half its height
WINDOW_BANDWIDTH = 1.81  # over its length: where its transform is above half its height
WINDOW_LOBE = 2.0  # over its length: half the main lobe of its transform

ORDER = 4
BANDWIDTH = 1.019
"""Parameter b of a gammatone of order 4 over its equivalent rectangular bandwidth."""
PEAK = (ORDER - 1) / (2.0 * np.pi)  # where the envelope is greatest, over b
HALF_HEIGHT = (0.222, 0.879)  # where it is above half of that, over b
HALF_BANDWIDTH = 2.0 * math.sqrt(4.0 ** (1.0 / ORDER) - 1.0)  # of the transform, in b
SKIRT = 3.0  # b from its middle the transform has fallen by 40 dB
FLOOR = 1e-3
"""Gammatone envelope, over its peak, at which the filter is cut off: -60 dB, the reported dynamic
range."""


@dataclass(frozen=True, eq=False)
class RowFilters:
    """The filters of a spectrogram."""

    frequency: Floats  # (F,), Hz: Frequencies of the rows, ascending
    envelope: Floats  # (F, W): Over the samples that a frame reads, 1 at its greatest or almost
    # First of these samples, from the frame's start; the ones before the emission are silent
    origin: int
    centre: float  # Centre of the envelopes, samples from the frame's start: the frame's time
    length: int  # Length of the Hamming window that is as wide as the mean over the band, samples
    band: tuple[float, float]  # (float, float), Hz: Pass band of the rows
    looks: float  # Number of independent values of noise in a mean over the band

    @property
    def reach(self) -> int:
        """Number of samples, from its start on, that a frame reads."""
        return self.origin + self.envelope.shape[1]

    def point_echo(self) -> Floats:
        """Return the envelope of an impulse in each row, (F, W') over samples.

        The frame's time is in the middle of the W' samples.
        """
        if self.origin == 0 and self.centre == (self.envelope.shape[1] - 1) / 2.0:
            return self.envelope.copy()
        # Sample n of an envelope is heard centre - n after the impulse's own time.
        peak = round(self.centre) - self.origin
        side = max(peak, self.envelope.shape[1] - 1 - peak)
        before, after = side - (self.envelope.shape[1] - 1 - peak), side - peak
        return np.pad(self.envelope[:, ::-1], ((0, 0), (before, after)))


def row_frequencies(settings: SpectrogramSettings) -> Floats:
    """Frequencies of the rows, (F,) Hz, ascending."""
    if settings.kind == "gammatone":
        return np.geomspace(settings.frequency_min, settings.frequency_max, settings.channels)
    first, last = fft_bins(settings)
    bins = np.arange(first, last + 1, dtype=np.float64)
    return bins * (settings.sampling_rate / settings.fft)


def fft_bins(settings: SpectrogramSettings) -> tuple[int, int]:
    """Numbers of the FFT's bins nearest to the two ends of the band."""
    width = settings.sampling_rate / settings.fft
    return round(settings.frequency_min / width), round(settings.frequency_max / width)


def band_mean(values: NDArray[Any], frequency: ArrayLike) -> NDArray[Any]:
    """Return the mean over frequency, each row with its part of the band.

    In: values (..., F), frequency ((F,), Hz).
    """
    part = band_parts(frequency)
    return np.asarray(values.mean(axis=-1) if part is None else values @ part)


def band_parts(frequency: ArrayLike) -> Floats | None:
    """Return the fraction of the band that each row (F,) stands for; None if all are the same."""
    f = np.asarray(frequency, dtype=np.float64)
    steps = np.diff(f)
    if len(steps) < 2 or np.ptp(steps) <= 1e-6 * steps.mean():
        return None
    part = np.gradient(f)
    return np.asarray(part / part.sum())


def row_widths(settings: SpectrogramSettings, frequency: ArrayLike) -> tuple[Floats, Floats]:
    """Duration of a row's envelope and bandwidth of its transform, each at half of its height.

    In: frequency ((F,), Hz). Out: (F,), (F,).
    """
    f = np.asarray(frequency, dtype=np.float64)
    if settings.kind == "gammatone":
        b = BANDWIDTH * f / settings.q
        return (HALF_HEIGHT[1] - HALF_HEIGHT[0]) / b, HALF_BANDWIDTH * b
    length = settings.window / settings.sampling_rate
    return np.full(f.shape, WINDOW_DURATION * length), np.full(f.shape, WINDOW_BANDWIDTH / length)


@lru_cache(maxsize=16)  # all readers of rows share the arrays; nobody may write to them
def row_filters(settings: SpectrogramSettings) -> RowFilters:
    """Return the filters of a spectrogram."""
    return _gammatone(settings) if settings.kind == "gammatone" else _hamming(settings)


def _hamming(settings: SpectrogramSettings) -> RowFilters:
    frequency, rate = row_frequencies(settings), settings.sampling_rate
    window = np.hamming(settings.window)
    margin = WINDOW_LOBE * rate / settings.window
    envelope = np.broadcast_to(window, (len(frequency), len(window)))
    return RowFilters(
        frequency=frequency,
        envelope=envelope,
        origin=0,
        centre=(settings.window - 1) / 2.0,
        length=settings.window,
        band=(float(frequency[0]) - margin, float(frequency[-1]) + margin),
        looks=_looks(envelope, frequency, rate),
    )


def _gammatone(settings: SpectrogramSettings) -> RowFilters:
    frequency, rate = row_frequencies(settings), settings.sampling_rate
    b = BANDWIDTH * frequency / settings.q
    before = int(_ring_off() * rate / b[0])
    after = math.ceil(PEAK * rate / b[0])
    # At its time t a frame hears sound of time t - u through the filter's value at u past its peak.
    past = np.arange(before, -after - 1, -1) / rate
    x = np.maximum(2.0 * np.pi * b[:, None] * past + (ORDER - 1), 0.0) / (ORDER - 1)
    envelope = (x * np.exp(1.0 - x)) ** (ORDER - 1)
    envelope[envelope < FLOOR] = 0.0
    mean = np.sqrt(band_mean((envelope**2).T, frequency))
    wide = np.flatnonzero(mean >= 0.5 * mean.max())
    return RowFilters(
        frequency=frequency,
        envelope=envelope,
        origin=-before,
        centre=0.0,
        length=max(round((wide[-1] - wide[0] + 1) / WINDOW_DURATION), 2),
        band=(float(frequency[0] - SKIRT * b[0]), float(frequency[-1] + SKIRT * b[-1])),
        looks=_looks(envelope, frequency, rate),
    )


def _looks(envelope: Floats, frequency: Floats, rate: float) -> float:
    """Return the number of independent values of white noise in the mean power over the band.

    It is the squared mean over the variance: overlapping rows share noise.
    """
    if len(frequency) < 2:
        return 1.0
    tone = np.exp(-2j * np.pi / rate * np.outer(frequency, np.arange(envelope.shape[1])))
    rows = envelope * tone
    power = (envelope**2).sum(axis=1)
    shared = np.abs(rows @ rows.conj().T) ** 2 / np.outer(power, power)
    mean = np.gradient(frequency) * power
    return float(mean.sum() ** 2 / (mean @ shared @ mean))


def _ring_off() -> float:
    """Return the time from the peak of the gammatone to its floor, over b."""
    x = np.linspace(1.0, 20.0, 20_000)
    last = x[(x * np.exp(1.0 - x)) ** (ORDER - 1) >= FLOOR][-1]
    return float((last - 1.0) * PEAK)
