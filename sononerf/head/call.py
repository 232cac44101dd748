# SPDX-License-Identifier: MIT
"""The emitted call: impulse, sweep with harmonics or a file, and its compression."""

from __future__ import annotations

import hashlib
import math
from dataclasses import dataclass
from fractions import Fraction
from functools import lru_cache
from pathlib import Path
from typing import Any, Protocol

import numpy as np
import scipy.fft
import scipy.ndimage
from numpy.typing import ArrayLike

from sononerf import storage
from sononerf.errors import InputError
from sononerf.head.row_filters import WINDOW_BANDWIDTH, WINDOW_DURATION
from sononerf.numerics import Bools, Floats
from sononerf.settings.schema import FILE_SECTIONS, CallSettings, EarSettings
from sononerf.wav_files import read_wav

MIN_HARMONIC = 0.25
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
    """Return the mask (F,) of the frequencies (F,), Hz, that the call emits."""
    f = np.asarray(frequency, dtype=np.float64)
    if settings.kind == "impulse":
        return np.ones(f.shape, dtype=bool)
    if settings.kind == "file":
        return _file(settings).covers(f)
    return np.any([(f >= low) & (f <= high) for low, high in settings.bands.values()], axis=0)


def has_ghosts(settings: CallSettings, frequency: ArrayLike) -> bool:
    """Return True if a point may appear at several ranges in a row that is dechirped once.

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
    loud = near & (loudness >= MIN_HARMONIC * loudness.max(axis=1, keepdims=True))
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


MAX_DURATION = 0.1  # s, as the settings' longest sweep
MIN_SAMPLES = 8  # samples
MOST_BYTES = 16_000_000
LARGEST_STEP = 10_000  # of a ratio of sampling rates
COVERED_DB = 20.0  # below the loudest frequency
SMOOTHING = 0.1  # of a spectrum to both sides, in bandwidths of the window
ENERGY = 0.99  # that a call's duration holds
LOUD_POWER = 0.0625  # of the power, 12 dB below the loudest: what is fainter is passed over
TOP_POWER = 0.7  # of an output's power: what lies above it tells the time
ROWS = 200  # frequencies that the delay is read at


@dataclass(frozen=True, eq=False)
class CallFile:
    """A recorded or computed call."""

    # (N,): From the file's first sample on, which is the start of the emission; its greatest is 1
    waveform: Floats
    sampling_rate: float  # (Hz): Sampling rate of the file
    frequency: Floats  # (K,), Hz: Ascending
    delay: Floats  # (K,), s: Time of emission of each
    is_covered: Bools  # (K,): Whether it is emitted
    bandwidth: float  # (Hz): Bandwidth of the window that it was looked at through

    @property
    def bands(self) -> list[tuple[float, float]]:
        """Lowest and highest frequency (Hz) of each stretch that is covered, ascending."""
        edges = np.flatnonzero(np.diff(self.is_covered, prepend=False, append=False))
        ends = edges.reshape(-1, 2)
        return [(float(self.frequency[a]), float(self.frequency[b - 1])) for a, b in ends]

    def resampled(self, sampling_rate: float) -> Floats:
        """Return the waveform at another rate (Hz), its first sample at the same time."""
        ratio = Fraction(sampling_rate / self.sampling_rate).limit_denominator(LARGEST_STEP)
        if ratio == 1:
            return self.waveform.copy()
        up, down = ratio.numerator, ratio.denominator
        import scipy.signal  # takes half a second

        return np.asarray(scipy.signal.resample_poly(self.waveform, up, down), dtype=np.float64)

    def covers(self, frequency: Floats) -> Bools:
        """Return the mask (F,) of the frequencies that the call emits."""
        return np.any([(frequency >= a) & (frequency <= b) for a, b in self.bands], axis=0)

    def delay_at(self, frequency: Floats) -> Floats:
        """Return when frequencies (F,) are emitted, s; beyond what is covered the nearest ones."""
        known = self.is_covered
        return np.interp(frequency, self.frequency[known], self.delay[known])

    def rate_at(self, frequency: Floats) -> Floats:
        """Return the sweep rate at frequencies (F,), Hz/s."""
        low, high = self.frequency[self.is_covered][[0, -1]]
        below = np.clip(frequency - self.bandwidth / 2.0, low, high)
        above = np.clip(frequency + self.bandwidth / 2.0, low, high)
        late = np.abs(self.delay_at(above) - self.delay_at(below))
        step = np.maximum(above - below, 1e-3 * self.bandwidth)
        return step / np.maximum(late, 1e-12)


def load_call(path: Path) -> CallFile:
    """Read a call."""
    try:
        status = path.stat()
    except OSError as error:
        why = "no such file" if isinstance(error, FileNotFoundError) else error.strerror
        raise InputError(f"{path}: {why}; call.file is the WAV of one call") from None
    if not path.is_file():
        raise InputError(f"{path}: is no file; call.file is the WAV of one call")
    return _load(path, status.st_mtime_ns, status.st_size)


@lru_cache(maxsize=4)
def _load(path: Path, changed: int, size: int) -> CallFile:
    del changed
    if size > MOST_BYTES:
        raise InputError(f"{path}: {size:,} bytes; cut one call out, of {MAX_DURATION:g} s at most")
    wav = read_wav(path)
    rate, samples = wav.true_rate or wav.rate, wav.samples[:, 0]
    if wav.samples.shape[1] != 1:
        raise InputError(
            f"{path}: {wav.samples.shape[1]} channels, expected 1; write out that of the call"
        )
    if len(samples) > MAX_DURATION * rate:
        raise InputError(
            f"{path}: lasts {len(samples) / rate:.3g} s, allowed is "
            f"{MAX_DURATION:g} s; cut one call out"
        )
    if len(samples) < MIN_SAMPLES:
        raise InputError(f"{path}: {len(samples)} samples, expected {MIN_SAMPLES} or more")
    waveform = samples.astype(np.float64)
    if samples.dtype == np.uint8:
        waveform -= 128.0  # 8 bits are stored without a sign
    if not np.isfinite(waveform).all():
        raise InputError(f"{path}: holds values that are not finite; write the file anew")
    highest = float(np.abs(waveform).max())
    if highest == 0.0:
        raise InputError(f"{path}: is silent; expected one call")
    return _examined(waveform / highest, float(rate))


def _examined(waveform: Floats, rate: float) -> CallFile:
    duration, band = _duration(waveform, rate), _bandwidth(waveform, rate)
    length = math.sqrt(WINDOW_BANDWIDTH / WINDOW_DURATION * duration / band)
    window = np.hamming(max(round(length * rate), MIN_SAMPLES))
    bandwidth = WINDOW_BANDWIDTH * rate / len(window)
    frequency = np.linspace(0.0, rate / 2.0, ROWS + 1)[1:]
    size = int(scipy.fft.next_fast_len(len(waveform) + 2 * len(window)))
    spectrum = np.fft.fft(waveform, size)
    ring = 2.0 * np.pi / rate * np.arange(len(window))
    # Output sample k holds the window that is centred here:
    time = (np.arange(size) - (len(window) - 1) / 2.0) / rate
    delay = np.zeros(len(frequency))
    for row, middle in enumerate(frequency):
        kernel = np.fft.fft(window * np.exp(1j * ring * middle), size)
        power = np.abs(np.fft.ifft(spectrum * kernel)) ** 2
        top = _first_top(power)
        low = np.flatnonzero(power < TOP_POWER * power[top])
        first = int(low[low < top].max(initial=-1)) + 1
        last = int(low[low > top].min(initial=size))
        above = power[first:last] - TOP_POWER * power[top] + 1e-300
        delay[row] = np.average(time[first:last], weights=above)
    loud = _loud(waveform, rate, frequency, bandwidth)
    return CallFile(waveform, rate, frequency, np.maximum(delay, 0.0), loud, bandwidth)


def _first_top(power: Floats) -> int:
    """Return where a row is loudest when the frequency is first emitted, if not 12 dB fainter."""
    loud = np.flatnonzero(power >= LOUD_POWER * power.max())
    ends = np.flatnonzero(np.diff(loud) > 1)
    end = int(loud[ends[0]] if len(ends) else loud[-1]) + 1
    return int(loud[0]) + int(power[loud[0] : end].argmax())


def _loud(waveform: Floats, rate: float, frequency: Floats, bandwidth: float) -> Bools:
    """Return the mask (F,) of the frequencies within 20 dB of the loudest."""
    power = np.abs(np.fft.rfft(waveform, 4 * len(waveform))) ** 2
    step = rate / (4 * len(waveform))
    wide = max(1, round(SMOOTHING * bandwidth / step))
    mean = np.convolve(np.pad(power, wide, mode="edge"), np.ones(2 * wide + 1), mode="valid")
    level = np.interp(frequency, step * np.arange(len(power)), mean)
    loud = level >= level.max() * 10.0 ** (-COVERED_DB / 10.0)
    gap = round(bandwidth / (frequency[1] - frequency[0]))
    return np.asarray(loud | scipy.ndimage.binary_closing(loud, np.ones(gap + 1)))


def _duration(waveform: Floats, rate: float) -> float:
    energy = np.cumsum(waveform**2)
    ends = np.searchsorted(energy, energy[-1] * np.array([(1.0 - ENERGY) / 2.0, (1 + ENERGY) / 2]))
    return float(ends[1] - ends[0] + 1) / rate


def _bandwidth(waveform: Floats, rate: float) -> float:
    power = np.abs(np.fft.rfft(waveform, 2 * len(waveform))) ** 2
    energy = np.cumsum(power)
    ends = np.searchsorted(energy, energy[-1] * np.array([(1.0 - ENERGY) / 2.0, (1 + ENERGY) / 2]))
    return float(ends[1] - ends[0] + 1) * rate / (2 * len(waveform))


def contents(path: Path) -> bytes:
    """Return all that a call depends on, for hashes: its samples and its sampling rate."""
    call = load_call(path)
    return np.float64(call.sampling_rate).tobytes() + call.waveform.astype("<f8").tobytes()


FOLDER = "attached"
"""Name of the folder of the copies, within that of the run or the store."""


class NamesFiles(Protocol):
    """A head, or settings."""

    @property
    def ears(self) -> EarSettings:
        """May name the file of a directivity."""

    @property
    def call(self) -> CallSettings:
        """May name the file of a call."""


def attach(head: NamesFiles, folder: Path) -> None:
    """Copy the files that a head names into a folder, if they are not there yet."""
    for section in FILE_SECTIONS:
        file = getattr(head, section).file
        if file is None or (copy := _copy_of(file, section, folder)).is_file():
            continue
        try:
            content = file.read_bytes()
        except OSError as error:
            raise InputError(f"{file}: cannot be read ({error.strerror})") from None
        storage.make_folder(copy.parent)
        storage.commit_bytes(copy, content)


def attached(head: NamesFiles, folder: Path) -> dict[str, Any]:
    """Return the sections, by name, whose file has a copy in a folder; ``file`` is the copy."""
    content = {}
    for section in FILE_SECTIONS:
        own = getattr(head, section)
        if own.file is not None and (copy := _copy_of(own.file, section, folder)).is_file():
            content[section] = own.model_copy(update={"file": copy})
    return content


def _copy_of(file: Path, section: str, folder: Path) -> Path:
    return folder / FOLDER / f"{section}{file.suffix}"
