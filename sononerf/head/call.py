# SPDX-License-Identifier: MIT
"""The emitted call (impulse, sweep with harmonics, or a file's waveform) and its compression."""

from __future__ import annotations

import hashlib
import math
from typing import Any

import numpy as np
import scipy.fft
from numpy.typing import ArrayLike

from sononerf.head.call_file import CallFile, contents, load_call
from sononerf.numerics import Bools, Floats
from sononerf.settings.schema import CallSettings

LOUD = 0.25
"""Height of a harmonic, over that of the loudest one, from which it counts. Fainter echoes are not
taken for onsets, which are read at a tenth of the power."""


def call_waveform(settings: CallSettings, sampling_rate: float) -> Floats:
    r"""Pressure of the call, from the start of the emission on.

    Harmonic :math:`h` of relative amplitude :math:`a_h` has :math:`h` times the fundamental's
    phase :math:`\varphi`, so it sweeps :math:`h` times the fundamental's frequencies at once,

    .. math:: p(t) = w(t) \sum_h a_h \cos(h \varphi(t)) / \sum_h a_h

    with a cosine-tapered (Tukey) envelope :math:`w`. With :math:`f_0, f_1` the first and last
    frequency and :math:`T` the duration,

    .. math::
        \varphi(t) = 2 \pi \left(f_0 t + \frac{f_1 - f_0}{2 T} t^2\right) \quad\text{(linear)},
        \qquad \varphi(t) = \frac{2 \pi}{k} \ln(1 + k f_0 t), \quad
        k = \frac{1 / f_1 - 1 / f_0}{T} \quad\text{(hyperbolic)}

    so that a hyperbolic sweep's period runs straight, and it bears Doppler shifts [1]_.

    In: sampling_rate (Hz). Out: waveform (N,).

    References:
        .. [1] J. J. Kroszczynski, "Pulse compression by means of linear-period modulation",
           Proceedings of the IEEE 57(7), 1969.
    """
    if settings.kind == "impulse":
        return np.ones(1)
    if settings.kind == "file":
        return _file(settings).resampled(sampling_rate)
    duration = settings.duration
    time = np.arange(math.ceil(duration * sampling_rate) + 1) / sampling_rate
    phase = _phase(settings, np.minimum(time, duration))
    amplitude = np.asarray(settings.harmonics)
    number = np.arange(1, len(amplitude) + 1)
    swept = amplitude / amplitude.sum() @ np.cos(number[:, None] * phase)
    return _envelope(settings, time) * swept


def _file(settings: CallSettings) -> CallFile:
    assert settings.file is not None  # the settings see to it
    return load_call(settings.file)


def _phase(settings: CallSettings, time: Floats) -> Floats:
    start, end = settings.frequency_start, settings.frequency_end
    if settings.kind == "linear":
        return 2.0 * np.pi * (start + (end - start) / (2.0 * settings.duration) * time) * time
    k = (1.0 / end - 1.0 / start) / settings.duration
    return 2.0 * np.pi / k * np.log1p(k * start * time)


def _envelope(settings: CallSettings, time: Floats) -> Floats:
    inside = np.minimum(time, settings.duration - time)  # s, from the nearer end
    flank = settings.taper * settings.duration / 2.0
    rise = np.clip(inside / flank, 0.0, 1.0) if flank > 0.0 else 1.0
    return np.where(inside < 0.0, 0.0, 0.5 - 0.5 * np.cos(np.pi * rise))


def covered(settings: CallSettings, frequency: ArrayLike) -> Bools:
    """Return which frequencies the call emits.

    In: frequency ((F,), Hz). Out: covered (F,).
    """
    f = np.asarray(frequency, dtype=np.float64)
    if settings.kind == "impulse":
        return np.ones(f.shape, dtype=bool)
    if settings.kind == "file":
        return _file(settings).covers(f)
    return np.any([(f >= low) & (f <= high) for low, high in settings.bands.values()], axis=0)


def has_ghosts(settings: CallSettings, frequency: ArrayLike) -> bool:
    """Return whether a point may be heard at several ranges in a row that is dechirped once.

    That is so where several harmonics sweep over one of the frequencies, each at a time of its own,
    and has to be expected of a file.

    In: frequency ((F,), Hz).
    """
    f = np.asarray(frequency, dtype=np.float64)
    if settings.kind == "file":
        return True
    sweeping = [(f >= low) & (f <= high) for low, high in settings.bands.values()]
    return bool((np.sum(sweeping, axis=0) > 1).any())


def _carrier(settings: CallSettings, frequency: Floats) -> tuple[Floats, Floats]:
    """Which harmonic sweeps nearest to each frequency, the first of several, and where; (F,).

    Those that are 12 dB fainter there than another one are passed over. The slower a harmonic
    sweeps over a frequency, and the farther it is from a tapered end, the louder it is there.
    """
    harmonic = np.asarray(list(settings.bands), dtype=np.float64)
    low, high = np.asarray(list(settings.bands.values())).T
    amplitude = np.asarray([settings.harmonics[int(h) - 1] for h in harmonic])
    f = frequency[:, None]
    off = np.maximum(np.maximum(low - f, f - high), 0.0)
    # Relative to the fundamental: a linear sweep's rate is h, a hyperbolic one's 1 / h.
    slowness = amplitude * harmonic ** (-0.5 if settings.kind == "linear" else 0.5)
    time = _time_of(settings, np.clip(f, low, high), harmonic)
    near = off == off.min(axis=1, keepdims=True)
    loudness = np.where(near, slowness * _envelope(settings, time), 0.0)
    loud = near & (loudness >= LOUD * loudness.max(axis=1, keepdims=True))
    first = np.where(loud, time, np.inf).argmin(axis=1)
    return harmonic[first], np.clip(frequency, low[first], high[first])


def _time_of(settings: CallSettings, swept: Floats, harmonic: Floats) -> Floats:
    """Return when harmonics have frequencies (Hz) that they sweep over, s."""
    start, end = settings.frequency_start, settings.frequency_end
    if settings.kind == "linear":
        share = (swept / harmonic - start) / (end - start)
    else:
        share = (harmonic / swept - 1.0 / start) / (1.0 / end - 1.0 / start)
    return settings.duration * np.clip(share, 0.0, 1.0)


def sweep_delay(settings: CallSettings, frequency: ArrayLike) -> Floats:
    r"""Return the time at which each frequency is emitted, from the start of the emission.

    The fundamental is at :math:`f` at :math:`T (f - f_0) / (f_1 - f_0)` in a linear sweep and at
    :math:`T (1/f - 1/f_0) / (1/f_1 - 1/f_0)` in a hyperbolic one.

    In: frequency ((F,), Hz). Out: delay ((F,), s).

    Examples:
        >>> sweep = dict(kind="linear", duration=1e-3, frequency_start=90e3, frequency_end=40e3)
        >>> call = CallSettings(**sweep)
        >>> [round(1e6 * float(delay)) for delay in sweep_delay(call, [90e3, 60e3, 20e3])]
        [0, 600, 1000]
    """
    f = np.asarray(frequency, dtype=np.float64)
    if settings.kind == "impulse":
        return np.zeros(f.shape)
    if settings.kind == "file":
        return _file(settings).delay_at(f)
    harmonic, swept = _carrier(settings, f)
    return _time_of(settings, swept, harmonic)


def sweep_rate(settings: CallSettings, frequency: ArrayLike) -> Floats:
    r"""Rate at which the call sweeps over each frequency.

    :math:`h |f_1 - f_0| / T` for harmonic :math:`h` of a linear sweep, :math:`|k| f^2 / h` of a
    hyperbolic one.

    In: frequency ((F,), Hz). Out: rate ((F,), Hz/s), infinite where nothing is swept.
    """
    f = np.asarray(frequency, dtype=np.float64)
    if settings.kind == "impulse":
        return np.full(f.shape, np.inf)
    if settings.kind == "file":
        return _file(settings).rate_at(f)
    harmonic, swept = _carrier(settings, f)
    start, end = settings.frequency_start, settings.frequency_end
    if settings.kind == "linear":
        return harmonic * (abs(end - start) / settings.duration)
    k = abs(1.0 / end - 1.0 / start) / settings.duration
    return k * swept**2 / harmonic


def call_content(settings: CallSettings) -> dict[str, Any]:
    """Return all properties of a call that echoes depend on, as plain data, for hashes.

    A preset counts by its values, a file by its content.
    """
    plain = settings.model_dump(mode="json", exclude={"preset", "file"})
    if settings.file is None:
        return plain
    return {"kind": "file", "content": hashlib.sha256(contents(settings.file)).hexdigest()}


def emit(impulse_responses: ArrayLike, waveform: Floats) -> Floats:
    """Pressure at the ears when the call is emitted in place of an impulse.

    In: impulse_responses (E, S), waveform (N,). Out: echo (E, S + N - 1).
    """
    responses = np.asarray(impulse_responses, dtype=np.float64)
    if len(waveform) == 1:
        return responses * waveform[0]  # no rounding by transforms
    import scipy.signal  # takes half a second

    return scipy.signal.fftconvolve(responses, waveform[None], axes=-1)


EPSILON = 0.01
"""Power spectrum of the call, over its maximum, below which the division by it is regularised: -20
dB, at which a call counts as covering a frequency."""


def inverse_filter(recordings: ArrayLike, call: ArrayLike) -> Floats:
    """Replace each echo of a call by that of an impulse.

    In: recordings (..., S), call (N,). Out: compressed (..., S).
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
    compressed: Floats = np.fft.irfft(np.fft.rfft(heard, length) * inverse, length)
    return compressed[..., :samples]
