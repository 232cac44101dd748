# SPDX-License-Identifier: MIT
"""The front end: from the waveform of an echo to its spectrogram.

In: waveform (E, S), from the emission on. Out: magnitudes (E, R, F), linear. Each row is one
complex filter (:mod:`sononerf.head.row_filters`), shifted by the time at which the call emits its
frequency (dechirp), so that a sweep is as sharp in range as an impulse. Ranges are ``c t / 2`` with
t at the centre of the window. ``docs/simulator.md``, Front end; the paper's spectrograms:
``docs/paper.md``.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from typing import Any, NamedTuple

import numpy as np
import scipy.fft
from numpy.lib.stride_tricks import sliding_window_view
from numpy.typing import ArrayLike, NDArray

from sononerf.errors import NumericalError
from sononerf.head.call import call_waveform, sweep_delay
from sononerf.head.row_filters import BANDWIDTH, SKIRT, fft_bins, row_filters, row_frequencies
from sononerf.numerics import Complexes, Floats, Ints
from sononerf.settings.schema import CallSettings, SpectrogramSettings


def frequency_axis(settings: SpectrogramSettings) -> Floats:
    """Frequencies of the rows, see :mod:`sononerf.head.row_filters`.

    Of the kind ``stft`` the FFT's bins nearest to the two ends, and all between,
    ``sampling_rate / fft`` apart; of ``gammatone`` equal ratios from one end to the other.

    Out: frequency ((F,), Hz).

    Examples:
        >>> axis = frequency_axis(SpectrogramSettings())
        >>> len(axis), float(axis[0]), float(axis[-1])
        (47, 9765.625, 99609.375)
    """
    return row_frequencies(settings)


def range_axis(settings: SpectrogramSettings, speed_of_sound: float) -> Floats:
    """Ranges of the analysis frames, ``c t / 2`` with t at the centre of the frame's envelopes.

    In: speed_of_sound (m/s). Out: range ((R,), m).

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
    """Number of samples from the emission on that the last analysis frame needs.

    In: speed_of_sound (m/s), longest_delay (s).
    """
    last = _frames(settings, speed_of_sound)[1]
    half_length = row_filters(settings).reach
    return last * settings.hop + half_length + math.ceil(longest_delay * settings.sampling_rate)


def dechirped_spectrogram(
    echo: ArrayLike,
    settings: SpectrogramSettings,
    speed_of_sound: float,
    delay: ArrayLike | None = None,
) -> Floats:
    r"""Magnitude in the rows' filters on the range and frequency axes, dechirped.

    Of the kind ``stft`` that is the short-time Fourier transform with a symmetric Hamming window,
    unnormalised. A sweep emits each frequency at a time :math:`\tau(f)` of its own; its row is
    advanced by exactly that [1]_,

    .. math:: S(r, f) = \left| X\left(\tfrac{2 r}{c} + \tau(f), f\right) \right|

    with :math:`X(t, f)` the output of the filter whose envelope is centred at :math:`t`, between
    two samples too.

    In: echo (E, S), speed_of_sound (m/s), delay ((F,), s). Out: magnitude (E, R, F).

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
    # So few bins of so short a window are quicker as a product of matrices than as transforms.
    turn = 2.0 * np.pi / settings.fft * np.arange(settings.window)[:, None]
    turn = turn * np.arange(low, high + 1)
    window = np.hamming(settings.window)[:, None]
    real, imaginary = (np.square(frames @ (window * part)) for part in (np.cos(turn), np.sin(turn)))
    return np.sqrt(real + imaginary)


def _filtered(
    signal: Floats, settings: SpectrogramSettings, starts: slice, delay: Floats
) -> Floats:
    """Each frequency's row as a filter, an envelope on that frequency; a delay is then a phase."""
    filters = row_filters(settings)
    delays = np.broadcast_to(delay, filters.frequency.shape)
    # Before the emission a filter reads the silence behind the signal's end.
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


WIDEST = 8.0
"""Lowest frequency to which the skirt of a gammatone is followed, as the fraction 1/WIDEST of its
centre frequency."""


class Smearing(NamedTuple):
    """Response of the rows to fine frequencies."""

    frequency: Floats  # (N,), Hz: The fine ones, ascending
    rows: Ints  # (F, K): Indices of those that each row hears
    # (F, K) float64 or complex128: Weights: of a sound's pressure for an impulse, of its power for
    # a sweep. The sum is 1, for complex weights its magnitude
    weight: Floats | Complexes
    # (F, K) or None, s: The weight times how much later than the row's own frequency each one is
    # emitted; None for an impulse
    later: Floats | None


def smearing(call: CallSettings, spectrogram: SpectrogramSettings) -> Smearing:
    """Return the response of the rows to a call.

    A filter does not resolve frequencies closer than its bandwidth: it smears a varying spectrum
    over them. Of an impulse the value at the middle of an echo is the spectrum's mean under the
    filter's transform about its own time. A sweep's frequencies enter the filter one after the
    other; by Parseval's theorem a row hears the mean power, each frequency weighted with the
    squares of the filter's transform and of the call's spectrum.
    """
    return (_of_gammatones if spectrogram.kind == "gammatone" else _of_a_window)(call, spectrogram)


def _of_a_window(call: CallSettings, spectrogram: SpectrogramSettings) -> Smearing:
    frequencies = frequency_axis(spectrogram)
    step = spectrogram.sampling_rate / spectrogram.fft
    window = np.hamming(spectrogram.window)
    # The transform about the window's own middle is real; two main lobes on each side suffice.
    half_width = math.ceil(4.0 * spectrogram.fft / spectrogram.window)
    time = np.arange(spectrogram.window) - (spectrogram.window - 1) / 2.0
    offsets = np.arange(-half_width, half_width + 1)
    smear = np.cos(2.0 * np.pi / spectrogram.fft * np.outer(offsets, time)) @ window
    first = round(float(frequencies[0]) / step) - half_width
    count = len(frequencies) + 2 * half_width
    # Below the first bin and above half the sampling rate there is nothing to hear.
    bins = np.clip(np.arange(first, first + count), 1, spectrogram.fft // 2)
    fine = bins.clip(1) * step + np.arange(count) * 1e-9
    rows = np.arange(len(frequencies))[:, None] + np.arange(
        2 * half_width + 1
    )  # (F, K) of the fine bins
    if call.kind == "impulse":
        return Smearing(fine, rows, np.tile(smear / smear.sum(), (len(frequencies), 1)), None)
    waveform = call_waveform(call, spectrogram.sampling_rate)
    finer = math.ceil(len(waveform) / spectrogram.fft)
    emitted = np.fft.rfft(waveform, finer * spectrogram.fft)[finer * bins]
    weight = smear**2 * (np.abs(emitted) ** 2)[rows]
    weight /= weight.sum(axis=1, keepdims=True)
    delay = sweep_delay(call, bins * step)
    return Smearing(
        fine, rows, weight, weight * (delay[rows] - sweep_delay(call, frequencies)[:, None])
    )


def _of_gammatones(call: CallSettings, spectrogram: SpectrogramSettings) -> Smearing:
    filters, rate = row_filters(spectrogram), spectrogram.sampling_rate
    frequencies = filters.frequency
    # Fine frequencies are some to a channel, and some to a bandwidth, in equal ratios too.
    between = math.log(frequencies[-1] / frequencies[0]) / (len(frequencies) - 1)
    finer = max(1, math.ceil(4.0 * spectrogram.q * between))
    step = between / finer
    skirt = SKIRT * BANDWIDTH / spectrogram.q
    below = math.ceil(-math.log(max(1.0 - skirt, 1.0 / WIDEST)) / step)
    above = math.ceil(math.log(1.0 + skirt) / step)
    count = finer * (len(frequencies) - 1) + 1 + below + above
    exact = frequencies[0] * np.exp(step * (np.arange(count) - below))
    fine = np.minimum(exact, rate / 2.0) + np.arange(count) * 1e-9
    rows = finer * np.arange(len(frequencies))[:, None] + np.arange(below + above + 1)
    time = np.arange(filters.envelope.shape[1]) + filters.origin - filters.centre
    turn = 2j * np.pi / rate * time
    weight = np.stack(
        [
            np.exp(np.outer(exact[which] - row, turn)) @ envelope
            for which, row, envelope in zip(rows, frequencies, filters.envelope, strict=True)
        ]
    )
    # A fine frequency stands for a part of the axis that grows with it.
    weight *= np.where(exact <= rate / 2.0, exact, 0.0)[rows]
    if call.kind == "impulse":
        return Smearing(fine, rows, weight / abs(weight.sum(axis=1, keepdims=True)), None)
    waveform = call_waveform(call, rate)
    sample = np.arange(len(waveform))
    emitted = np.array([waveform @ np.exp(-2j * np.pi / rate * each * sample) for each in fine])
    power = np.abs(weight) ** 2 / exact[rows] * (np.abs(emitted) ** 2)[rows]
    power /= np.maximum(power.sum(axis=1, keepdims=True), 1e-300)
    delay = sweep_delay(call, fine)
    return Smearing(
        fine, rows, power, power * (delay[rows] - sweep_delay(call, frequencies)[:, None])
    )


RANGE_DB = 60.0
"""Level of the loudest cell above the reference, dB; also the scale of PSNR and SSIM."""
ACTIVE_DB = 3.0
"""Level from which a cell is active, dB."""
FALSE_ACTIVE_RATE = 1e-3
"""Probability that a cell of noise counts as active, no unit: one cell in a thousand does not move
a mean over active cells."""
CHUNK_POSES = 8
"""Number of poses that are compared at once; more of them would only take more memory."""


def compress(magnitude: ArrayLike, reference: float) -> Floats:
    """Decibels above a soft floor, ``20 log10(1 + magnitude / reference)``.

    In: magnitude (...,). Out: level_db ((...,), dB).
    """
    if not reference > 0.0:
        raise ValueError(f"reference is {reference}, expected above 0")
    return (20.0 / math.log(10.0)) * np.log1p(np.asarray(magnitude, dtype=np.float64) / reference)


def active_level(noise: ArrayLike | None, reference: float) -> float | Floats:
    """Return the level from which a cell is active, dB: one number, or (E, 1, F) above noise.

    In: noise ((E, F) or None).
    """
    if noise is None:
        return ACTIVE_DB
    exceeded = np.asarray(noise, dtype=np.float64) * math.sqrt(math.log(1.0 / FALSE_ACTIVE_RATE))
    return np.maximum(compress(exceeded, reference), ACTIVE_DB)[:, None]


def expand(level_db: ArrayLike, reference: float) -> Floats:
    """Return the linear magnitude of compressed levels: the inverse of :func:`compress`."""
    return reference * (10.0 ** (np.asarray(level_db) / 20.0) - 1.0)


def same_shape(measured: ArrayLike, predicted: ArrayLike) -> tuple[Any, Any]:
    """Return both as arrays; raises ValueError if their shapes differ or they are empty."""
    a, b = np.asanyarray(measured), np.asanyarray(predicted)
    if a.shape != b.shape:
        raise ValueError(f"measured {a.shape} and predicted {b.shape} differ in shape")
    if not a.size:
        raise ValueError(f"measured has shape {a.shape}: nothing to compare")
    return a, b


def pose_chunks(
    measured: NDArray[np.floating], predicted: NDArray[np.floating]
) -> Iterator[tuple[Floats, Floats]]:
    """Yield a few poses of both at a time; raises NumericalError at a value that is not finite."""
    for start in range(0, len(measured), CHUNK_POSES):
        a, b = (
            np.asarray(spectrograms[start : start + CHUNK_POSES], dtype=np.float64)
            for spectrograms in (measured, predicted)
        )
        for name, values in (("measured", a), ("predicted", b)):
            if not np.isfinite(values).all():
                pose = start + int(np.argwhere(~np.isfinite(values))[0][0])
                raise NumericalError(f"the {name} spectrogram {pose} holds values not finite")
        yield a, b


def mae_all_and_active(
    measured: NDArray[np.floating], predicted: NDArray[np.floating], active_db: float | Floats
) -> tuple[float, float | None]:
    """Mean absolute error over all cells, and over active ones; None where none is active."""
    total = active_total = 0.0
    active_count = 0
    for a, b in pose_chunks(measured, predicted):
        error = np.abs(a - b)
        active = (a >= active_db) | (b >= active_db)
        total += float(error.sum())
        active_total += float(error[active].sum())
        active_count += int(active.sum())
    return total / measured.size, active_total / active_count if active_count else None


def mae_db(
    a: ArrayLike, b: ArrayLike, *, active: bool = False, active_db: float | Floats = ACTIVE_DB
) -> float | None:
    """Mean absolute difference of two sets of spectrograms.

    In: a, b ((P, ...), dB), active_db (dB). Out: error (dB).
    """
    first, second = same_shape(a, b)
    return mae_all_and_active(first, second, active_db)[1 if active else 0]
