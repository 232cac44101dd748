# SPDX-License-Identifier: MIT
"""Air, the match of call and filters, and the noise of the ears.

Noise is white and Gaussian, set by a signal-to-noise ratio of powers within the analysis
band, in the waveform as the ear receives it, before dechirp and filters: the mean power of an echo
over its loudest stretch, as long as the call lasts but at least one analysis window, to the noise's
power. Which echo is meant is a choice:

``target``
    That of a target of ``target_strength_db`` at ``target_distance``, on the beam's axis, to an
    ear of gain 1, in air that absorbs nothing. Microphones have one noise level whatever they
    hear, so this is the default: quiet poses lie below the noise.
``pose``
    The ear's own, so that all poses have the same ratio. A silent ear has no noise.

Either way a pose's noise depends on settings, seed and the pose alone.
"""

from __future__ import annotations

import logging
import math

import numpy as np
import scipy.fft
from numpy.typing import ArrayLike

from sononerf.head.call import (
    call_waveform,
    covered,
    has_ghosts,
    load_call,
    sweep_delay,
    sweep_rate,
)
from sononerf.head.front_end import dechirped_spectrogram, echo_samples, frequency_axis
from sononerf.head.row_filters import WINDOW_BANDWIDTH, WINDOW_DURATION, row_filters, row_widths
from sononerf.numerics import Floats
from sononerf.settings.schema import AirSettings, CallSettings, NoiseSettings, SpectrogramSettings

DEFAULT_SPEED = 343.0  # m/s
DEFAULT_TEMPERATURE = 20.0  # °C, for absorption where only the speed is fixed
LOWEST_OVER_PRESSURE = 4e-4  # Hz/Pa, of ISO 9613-1
REFERENCE_PRESSURE = 101_325.0  # Pa
REFERENCE_TEMPERATURE = 293.15  # K
TRIPLE_POINT = 273.16  # K


def speed_of_sound(temperature_c: float) -> float:
    """Speed of sound in air.

    In: temperature_c (°C). Out: speed (m/s).

    Examples:
        >>> round(speed_of_sound(20.0), 1)
        343.2
    """
    return float(343.2 * np.sqrt((temperature_c + 273.15) / REFERENCE_TEMPERATURE))


def speed_in(air: AirSettings) -> float:
    """Return the speed of sound (m/s) of settings: as set, from the temperature, or 343."""
    if air.speed_of_sound is not None:
        return air.speed_of_sound
    return DEFAULT_SPEED if air.temperature_c is None else speed_of_sound(air.temperature_c)


def absorption_in(air: AirSettings, frequency: ArrayLike) -> Floats:
    """Return the absorption (F,), dB/m, of the air that settings describe, at (F,) Hz.

    Below the lowest frequency of the standard it is that of the lowest frequency.
    """
    return air_absorption(
        np.maximum(frequency, LOWEST_OVER_PRESSURE * air.pressure_pa),
        temperature_c=DEFAULT_TEMPERATURE if air.temperature_c is None else air.temperature_c,
        relative_humidity=air.relative_humidity,
        pressure=air.pressure_pa,
    )


def air_absorption(
    frequency: ArrayLike,
    *,
    temperature_c: float = 20.0,
    relative_humidity: float,
    pressure: float = REFERENCE_PRESSURE,
) -> Floats:
    r"""Attenuation of a pure tone by still air, in decibels per metre.

    .. math:: \alpha(f) = 8.686 f^2 \left[ A_\mathrm{cl} + A_\mathrm{O} + A_\mathrm{N} \right]

    A bat hears the echo after a *two-way* path: multiply by ``2 * range``.

    In: frequency ((...,), Hz), temperature_c (°C), relative_humidity (1), pressure (Pa). Out:
    absorption ((...,), dB/m).

    References:
        .. [1] ISO 9613-1:1993, equations (3) to (5), (B.1) to (B.3).

    Examples:
        >>> frequency = [20e3, 50e3, 100e3]
        >>> absorption = air_absorption(frequency, temperature_c=20.0, relative_humidity=0.5)
        >>> [round(float(value), 3) for value in absorption]
        [0.524, 1.661, 3.28]
    """
    f = np.asarray(frequency, dtype=np.float64)
    if not -20.0 <= temperature_c <= 50.0:
        raise ValueError(f"temperature_c is {temperature_c}, expected -20 to 50")
    if not 0.0 <= relative_humidity <= 1.0:
        raise ValueError(f"relative_humidity is {relative_humidity}, expected 0 to 1")
    if not ((f / pressure >= 4e-4) & (f / pressure <= 10.0)).all():
        raise ValueError(f"frequency / pressure lies outside 4e-4 to 10 Hz/Pa at {pressure} Pa")
    kelvin = temperature_c + 273.15
    t = kelvin / REFERENCE_TEMPERATURE
    p = pressure / REFERENCE_PRESSURE
    saturation = 10.0 ** (-6.8346 * (TRIPLE_POINT / kelvin) ** 1.261 + 4.6151)  # (B.2), (B.3)
    h = 100.0 * relative_humidity * saturation / p  # molar concentration of water in %, (B.1)
    oxygen = p * (24.0 + 4.04e4 * h * (0.02 + h) / (0.391 + h))  # Hz, (3)
    nitrogen = p * t**-0.5 * (9.0 + 280.0 * h * np.exp(-4.170 * (t ** (-1.0 / 3.0) - 1.0)))  # (4)
    classical = 1.84e-11 / p * np.sqrt(t)
    of_oxygen = 0.01275 * np.exp(-2239.1 / kelvin) / (oxygen + f**2 / oxygen)
    of_nitrogen = 0.1068 * np.exp(-3352.0 / kelvin) / (nitrogen + f**2 / nitrogen)
    return (
        8.686 * f**2 * (classical + t**-2.5 * (of_oxygen + of_nitrogen))  # (5)
    )


NOISE_STREAM = 1  # keeps a pose's noise independent of other draws from its seed


def target_gain(target_strength_db: float, distance: float) -> float:
    """Echo of a small target, as a part of the call's pressure at 1 m.

    In: target_strength_db (dB), distance (m).

    References:
        .. [1] R. J. Urick, Principles of Underwater Sound, 3rd edition, 1983, table 9.1.

    Examples:
        >>> round(target_gain(-46.02, 0.4), 4)
        0.0313
    """
    return float(10.0 ** (target_strength_db / 20.0)) / distance**2


def loudest_power(echo: Floats, spectrogram: SpectrogramSettings, samples: int) -> Floats:
    """Mean power within the analysis band over an echo's loudest stretch.

    In: echo (E, S). Out: power (E,).
    """
    padded = np.pad(echo, ((0, 0), (samples, samples)))
    length = int(scipy.fft.next_fast_len(padded.shape[-1], real=True))
    frequency = np.fft.rfftfreq(length, 1.0 / spectrogram.sampling_rate)
    band = (frequency >= spectrogram.frequency_min) & (frequency <= spectrogram.frequency_max)
    heard = np.fft.irfft(np.fft.rfft(padded, length) * band, length)
    total = np.cumsum(heard**2, axis=-1)
    return (total[:, samples:] - total[:, :-samples]).max(axis=-1) / samples


def noise_level(settings: NoiseSettings, power: Floats, spectrogram: SpectrogramSettings) -> Floats:
    """Set each ear's noise: the standard deviation of its samples.

    In: power (E,). Out: level (E,).
    """
    share = (
        2.0 * (spectrogram.frequency_max - spectrogram.frequency_min) / spectrogram.sampling_rate
    )
    ratio = 10.0 ** (np.asarray(settings.snr_db, dtype=np.float64) / 10.0)
    return np.sqrt(power / (ratio * share))


def draw_noise(level: Floats, samples: int, *, seed: int) -> Floats:
    """White Gaussian noise, independent for each ear. In: level (E,). Out: noise (E, samples)."""
    generator = np.random.default_rng(np.random.SeedSequence(seed, spawn_key=(NOISE_STREAM,)))
    return level[:, None] * generator.standard_normal((len(level), samples))


logger = logging.getLogger("sononerf")

MAX_WINDOW_RATIO = 2.0  # ratio of a window to the best one, or its inverse, that is worth a warning
FAINT_POWER = 1e-3
"""Fraction of a point echo's power, no unit, that is cut off at its two ends: 30 dB below all of
it. A kernel that also holds the rest is ten times as long, and as slow."""
MAX_OTHER_ECHO = 4.0
"""Largest magnitude of another harmonic's echo of a point over that of its own: 12 dB."""


def row_duration(
    call: CallSettings, spectrogram: SpectrogramSettings, frequency: ArrayLike
) -> Floats:
    r"""Duration of a point echo in a row of the dechirped spectrogram.

    .. math:: \sqrt{T_w^2 + (B_w / |\dot f|)^2}

    with :math:`T_w` the filter's own duration, :math:`B_w` its bandwidth and :math:`|\dot f|` the
    sweep rate; each width is counted where the magnitude is above half its greatest (-6 dB). A
    row is the filter's transform, turned by the sweep's quadratic phase and transformed back; for
    a Gaussian filter and a linear sweep that gives exactly this.

    In: frequency ((F,), Hz). Out: duration ((F,), s).
    """
    lasts, wide = row_widths(spectrogram, frequency)
    return np.hypot(lasts, wide / sweep_rate(call, frequency))


def best_window(call: CallSettings, spectrogram: SpectrogramSettings) -> int:
    """Length of the window that keeps a point echo shortest in the dechirped spectrogram.

    A short window is wide in frequency, so a slow sweep stays in it for long; a long window is long
    itself. The result minimises the root mean square of :func:`row_duration` over the analysed
    frequencies that the call covers.

    Examples:
        >>> call = CallSettings(kind="linear", duration=3e-3)
        >>> best_window(call, SpectrogramSettings(frequency_min=40e3))
        306
    """
    if call.kind == "impulse" or spectrogram.kind == "gammatone":
        return spectrogram.window
    slowness = math.sqrt(np.mean(sweep_rate(call, _heard(call, spectrogram)) ** -2.0))
    return round(
        spectrogram.sampling_rate * math.sqrt(WINDOW_BANDWIDTH / WINDOW_DURATION * slowness)
    )


def suited(call: CallSettings, spectrogram: SpectrogramSettings) -> SpectrogramSettings:
    """Return the analysis; the keys that were not set are chosen for the call.

    The band is that of the loudest harmonic. If several are equally loud, it is that of the
    highest one, which sweeps fastest. (Where harmonics overlap, every point is heard twice.) The
    window is the one that makes a point echo shortest, and the hop is a sixteenth of the window.
    """
    given = spectrogram.model_fields_set
    if call.kind == "impulse":
        return spectrogram
    if not {"frequency_min", "frequency_max"} & given:
        if call.file is None:
            loudest = max(call.bands, key=lambda number: (call.harmonics[number - 1], number))
            ends = np.array(call.bands[loudest])
        else:
            ends = np.array(load_call(call.file).bands)
        high = min(float(ends.max()), spectrogram.sampling_rate / 2.0)
        band = {"frequency_min": float(ends.min()), "frequency_max": high}
        if band["frequency_min"] < high:
            kept = {name: getattr(spectrogram, name) for name in given}
            spectrogram = SpectrogramSettings.model_validate({**kept, **band})
    if spectrogram.kind == "gammatone":
        return spectrogram
    window = spectrogram.window if "window" in given else max(best_window(call, spectrogram), 8)
    chosen = {
        "window": window,
        "hop": max(window // 16, 1),
        "fft": max(spectrogram.fft, 2 ** math.ceil(math.log2(window))),
    }
    return spectrogram.model_copy(
        update={name: value for name, value in chosen.items() if name not in given}
    )


def within_band(spectrogram: SpectrogramSettings) -> Floats:
    """Return the rows' frequencies, the outermost moved to the ends of the analysed band."""
    return np.clip(
        frequency_axis(spectrogram), spectrogram.frequency_min, spectrogram.frequency_max
    )


def _heard(call: CallSettings, spectrogram: SpectrogramSettings) -> Floats:
    """Return those of the rows' frequencies that the call covers; all, where it covers none."""
    frequency = within_band(spectrogram)
    heard = covered(call, frequency)
    return frequency[heard] if heard.any() else frequency


def effective_window(call: CallSettings, spectrogram: SpectrogramSettings) -> Floats:
    """Point echo in each row of the dechirped spectrogram, as a window over the received time.

    Out: window (F, W).
    """
    frequency, filters = frequency_axis(spectrogram), row_filters(spectrogram)
    if call.kind == "impulse":
        return filters.point_echo()
    if spectrogram.kind == "gammatone" or has_ghosts(call, frequency):
        side = filters.envelope.shape[1] + call_waveform(call, spectrogram.sampling_rate).size
        return _cropped(_point_echo(call, spectrogram, side), call, spectrogram)
    length = spectrogram.window
    slowest = float(sweep_rate(call, _heard(call, spectrogram)).min())
    lobe = 2.0 * spectrogram.sampling_rate / length  # Hz, from the middle to the first zero
    extra = math.ceil(lobe / slowest * spectrogram.sampling_rate)
    row = _point_echo(call, spectrogram, extra + (length - 1) / 2.0)
    power = row**2 + row[:, ::-1] ** 2
    middle = power[:, (power.shape[1] - 1) // 2]
    return np.sqrt(power / middle[:, None])


def _point_echo(call: CallSettings, spectrogram: SpectrogramSettings, side: float) -> Floats:
    """Return a point's echo in each row, (F, W), as far as ``side`` samples to both sides."""
    centre = row_filters(spectrogram).centre
    side = math.ceil(side - centre % 1.0) + centre % 1.0
    count = round(2 * side) + 1
    # At a speed of 2 m/s ranges are seconds. Frame k is centred on sample k + centre.
    last = (centre + count - 0.5) / spectrogram.sampling_rate
    fine = spectrogram.model_copy(update={"hop": 1, "range_min": 0.0, "range_max": last})
    waveform = call_waveform(call, spectrogram.sampling_rate)
    delay = sweep_delay(call, frequency_axis(spectrogram))
    start = round(centre + side)
    samples = max(echo_samples(fine, 2.0, float(delay.max())), start + len(waveform))
    echo = np.zeros((1, samples))
    echo[0, start : start + len(waveform)] = waveform
    return dechirped_spectrogram(echo, fine, 2.0, delay)[0].T[:, :count]


def precursors(call: CallSettings, spectrogram: SpectrogramSettings) -> Floats:
    """Return the power of a point's precursors (L,), divided by that of its echo; one per sample.

    Each row also hears, faintly, the frequencies that the sweep emits before the row's own.
    """
    side = (
        row_filters(spectrogram).envelope.shape[1]
        + call_waveform(call, spectrogram.sampling_rate).size
    )
    row = _point_echo(call, spectrogram, side)
    heard = covered(call, within_band(spectrogram))
    row = row[heard] if heard.any() else row
    middle = (row.shape[1] - 1) // 2
    power = np.square(row / np.maximum(row[:, middle, None], 1e-12 * row.max())).mean(axis=0)
    return np.asarray(power[:middle][::-1] / power[middle])


def _cropped(row: Floats, call: CallSettings, spectrogram: SpectrogramSettings) -> Floats:
    """Return point echoes over their height at their own range, without faint columns."""
    width = row.shape[1]
    middle = row[:, [(width - 1) // 2, width // 2]].mean(axis=1)
    window = row / np.maximum(middle, 1e-12 * row.max())[:, None]
    heard = covered(call, within_band(spectrogram))
    if not heard.all() and heard.any():
        window[~heard] = np.minimum(window[~heard], 1.0)  # it has no middle of its own
    window = np.minimum(window, MAX_OTHER_ECHO)
    power = np.square(window[heard] if heard.any() else window).sum(axis=0)
    ends = np.cumsum(power + power[::-1])  # from both ends on
    spare = int(np.searchsorted(ends, FAINT_POWER * power.sum()))
    return window[:, spare : width - spare]


def warn_of_call(call: CallSettings, spectrogram: SpectrogramSettings) -> None:
    """Log one line for each mismatch of call and filters."""
    warn_of_band(call, spectrogram)
    best = best_window(call, spectrogram)
    if (
        spectrogram.kind == "stft"
        and not 1.0 / MAX_WINDOW_RATIO <= best / spectrogram.window <= MAX_WINDOW_RATIO
    ):
        here, there = (
            1e6 * math.sqrt(np.mean(row_duration(call, chosen, _heard(call, spectrogram)) ** 2))
            for chosen in (spectrogram, spectrogram.model_copy(update={"window": best}))
        )
        longer_fft = f" and spectrogram.fft={2 ** math.ceil(math.log2(best))}"
        logger.warning(
            "a point echo lasts %.0f µs in a window of %d samples and %.0f µs in the one that "
            "suits this call best; set spectrogram.window=%d%s",
            here,
            spectrogram.window,
            there,
            best,
            longer_fft if best > spectrogram.fft else "",
        )


def warn_of_band(call: CallSettings, spectrogram: SpectrogramSettings) -> None:
    """Log one line if a call does not cover the analysed band."""
    frequency = within_band(spectrogram)
    silent = ~covered(call, frequency)
    if silent.any():
        edges = np.flatnonzero(np.diff(silent, prepend=False, append=False)).reshape(-1, 2)
        bands = ", ".join(
            f"{frequency[a] / 1e3:.1f} to {frequency[b - 1] / 1e3:.1f} kHz" for a, b in edges
        )
        logger.warning(
            "the call does not cover %s; these rows hold next to nothing. Narrow "
            "spectrogram.frequency_min and frequency_max, or widen the call",
            bands,
        )
