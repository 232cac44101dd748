# SPDX-License-Identifier: MIT
"""A call or a directivity from a file, and the copies of such files beside a run or a store."""

from __future__ import annotations

import math
from dataclasses import dataclass
from fractions import Fraction
from functools import lru_cache
from pathlib import Path
from typing import Any, Protocol

import numpy as np
import scipy.fft
import scipy.ndimage

from sononerf import storage
from sononerf.errors import InputError
from sononerf.head.row_filters import WINDOW_BANDWIDTH, WINDOW_DURATION
from sononerf.numerics import Bools, Floats
from sononerf.settings.schema import FILE_SECTIONS, CallSettings, EarSettings
from sononerf.storage import read_wav

LONGEST = 0.1  # s, as the settings' longest sweep
SHORTEST = 8  # samples
MOST_BYTES = 16_000_000
LARGEST_STEP = 10_000  # of a ratio of sampling rates
COVERED_DB = 20.0  # below the loudest frequency
SMOOTHING = 0.1  # of a spectrum to both sides, in bandwidths of the window
ENERGY = 0.99  # that a call's duration holds
LOUD = 0.0625  # of the power, 12 dB below the loudest: what is fainter is passed over
TOP = 0.7  # of an output's power: what lies above it tells the time
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
        """Return which frequencies (F,) the call emits."""
        return np.any([(frequency >= a) & (frequency <= b) for a, b in self.bands], axis=0)

    def delay_at(self, frequency: Floats) -> Floats:
        """Return when frequencies (F,) are emitted, s; beyond what is covered the nearest ones."""
        known = self.is_covered
        return np.interp(frequency, self.frequency[known], self.delay[known])

    def rate_at(self, frequency: Floats) -> Floats:
        """Return how fast the call sweeps over frequencies (F,), Hz/s."""
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
        raise InputError(f"{path}: {size:,} bytes; cut one call out, of {LONGEST:g} s at most")
    rate, samples = read_wav(path)
    if samples.ndim != 1:
        raise InputError(
            f"{path}: {samples.shape[1]} channels, expected 1; write out the channel of the call"
        )
    if len(samples) > LONGEST * rate:
        raise InputError(
            f"{path}: lasts {len(samples) / rate:.3g} s, allowed is {LONGEST:g} s; cut one call out"
        )
    if len(samples) < SHORTEST:
        raise InputError(f"{path}: {len(samples)} samples, expected {SHORTEST} or more")
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
    window = np.hamming(max(round(length * rate), SHORTEST))
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
        low = np.flatnonzero(power < TOP * power[top])
        first = int(low[low < top].max(initial=-1)) + 1
        last = int(low[low > top].min(initial=size))
        above = power[first:last] - TOP * power[top] + 1e-300
        delay[row] = np.average(time[first:last], weights=above)
    loud = _loud(waveform, rate, frequency, bandwidth)
    return CallFile(waveform, rate, frequency, np.maximum(delay, 0.0), loud, bandwidth)


def _first_top(power: Floats) -> int:
    """Return where a row is loudest when the frequency is first emitted, if not 12 dB fainter."""
    loud = np.flatnonzero(power >= LOUD * power.max())
    ends = np.flatnonzero(np.diff(loud) > 1)
    end = int(loud[ends[0]] if len(ends) else loud[-1]) + 1
    return int(loud[0]) + int(power[loud[0] : end].argmax())


def _loud(waveform: Floats, rate: float, frequency: Floats, bandwidth: float) -> Bools:
    """Return which frequencies (F,) lie within 20 dB of the loudest."""
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
