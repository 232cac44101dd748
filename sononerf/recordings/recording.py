# SPDX-License-Identifier: MIT
"""A recording: its pings and channels, and how echoes are cut out of it."""

from __future__ import annotations

import hashlib
import io
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from functools import lru_cache
from pathlib import Path
from typing import Any

import numpy as np
import scipy.fft
from numpy.typing import ArrayLike, NDArray
from scipy.io import wavfile

from sononerf.echoes.detection import RANK, threshold_levels
from sononerf.echoes.memory_ensemble import SPLITS
from sononerf.errors import InputError
from sononerf.geometry.poses import Poses, euler_from_rotation
from sononerf.head.call import inverse_filter
from sononerf.numerics import Bools, Floats, Ints
from sononerf.recordings.pose_tables import Columns
from sononerf.settings.sections import Channels
from sononerf.wav_files import Wav, read_wav

WAV, OTHERS = (".wav",), (".flac", ".ogg", ".aiff", ".aif", ".w64", ".caf")
AUDIO = (*WAV, *OTHERS)


def read_audio(path: Path) -> Wav:
    """Read a sound file."""
    if not path.is_file():
        raise InputError(f"{path}: no such file")
    stamp = path.stat()
    return _read(path, stamp.st_mtime_ns, stamp.st_size)


@lru_cache(maxsize=2)  # one long file holds many pings
def _read(path: Path, *stamp: int) -> Wav:
    """Read a file as it was at a time and of a size."""
    del stamp
    wav = read_wav(path) if path.suffix.lower() in WAV else _other(path)
    if not wav.samples.size:
        raise InputError(f"{path}: holds no samples")
    return wav


def _other(path: Path) -> Wav:
    try:
        import soundfile
    except ImportError:
        raise InputError(
            f"{path}: {path.suffix} needs the package soundfile; install sononerf[audio], or save "
            "the recording as WAV"
        ) from None
    try:
        with soundfile.SoundFile(path) as file:
            bits = {"PCM_16": "int16", "PCM_24": "int32", "PCM_32": "int32", "PCM_S8": "int16"}
            samples = file.read(dtype=bits.get(file.subtype, "float64"), always_2d=True)
            if len(samples) != file.frames:
                raise InputError(f"{path}: truncated, {len(samples)} of {file.frames} samples")
            return Wav(file.samplerate, samples)
    except (soundfile.SoundFileError, RuntimeError) as error:
        said = " ".join(str(error).split())
        raise InputError(f"{path}: cannot be read as sound ({said})") from None


def as_float(samples: NDArray[Any]) -> Floats:
    """Return samples as floats; integers as fractions of the greatest that their type holds."""
    kind = samples.dtype
    if kind.kind == "u":
        middle = 2.0 ** (8 * kind.itemsize - 1)
        return (samples.astype(np.float64) - middle) / middle
    if kind.kind == "i":
        return samples.astype(np.float64) / 2.0 ** (8 * kind.itemsize - 1)
    return samples.astype(np.float64)


HEADER = "file,x_m,y_m,z_m,yaw_deg,pitch_deg,roll_deg,split"


def wav_bytes(waveform: ArrayLike, sampling_rate: float) -> bytes:
    """Return a WAV file of 32-bit floats, which keeps levels.

    In: waveform (E, S), sampling_rate (Hz).
    """
    if sampling_rate != round(sampling_rate):
        raise ValueError(f"a WAV file cannot hold a sampling rate of {sampling_rate} Hz")
    buffer = io.BytesIO()
    wavfile.write(buffer, round(sampling_rate), np.asarray(waveform, dtype=np.float32).T)
    return buffer.getvalue()


def pose_table(poses: Poses, files: Sequence[str], split: NDArray[np.int8]) -> str:
    """Return the table that the format ``recordings`` reads. In: split ((P,) int8)."""
    words = {number: word for word, number in SPLITS.items()}
    angles = (np.degrees(angle) for angle in euler_from_rotation(poses.rotations))
    numbers = np.column_stack([poses.positions, *angles])
    lines = [
        ",".join([name, *(repr(float(value)) for value in row), words[int(member)]])
        for name, row, member in zip(files, numbers, split, strict=True)
    ]
    return "\n".join([HEADER, *lines]) + "\n"


@dataclass(frozen=True, eq=False)
class Recording:
    """Recorded pings, and the table of their poses."""

    path: Path  # Path of the source, for messages
    sampling_rate: float  # Hz
    labels: tuple[str, ...]  # Name of each of the P pings in messages
    # (P,), s: Time of emission of each ping's call, counted from the first sample that :attr:`read`
    # gives. Negative where the recording began later
    emission: Floats
    # Takes the number of a ping and returns its samples (E, S) as they are on disk: integers reach
    # from one end of their type to the other, floats have the user's unit
    read: Callable[[int], NDArray[Any]]
    columns: Columns  # Poses as in the table, in its own frame
    # Statements of the source about ``air``, ``ears`` and ``call``: plain data by section
    settings: dict[str, dict[str, Any]] = field(default_factory=dict)
    notes: tuple[str, ...] = ()  # Interpretations that may surprise, one line each
    # (P,) or None, s: Time of emission of the next call in the same file; infinite where there is
    # none. None if each file holds one call
    until: Floats | None = None

    def __len__(self) -> int:
        return len(self.labels)


MIN_HEARD_FRACTION = 0.35
"""A channel counts as deaf if it heard echoes in less than this fraction of the pings in which
another channel heard one, no unit. Receivers beside one another hear the same body, and noise that
was pulse-compressed gives a false echo in up to a quarter of the pings."""
FAINT_DB = 40.0
"""A channel counts as faint if its echoes are weaker than the strongest channel's by more, dB: ears
that look apart differ by 20 to 30 dB."""
LOOKED_AT = 16
"""Number of pings whose samples are compared; a broken cable shows in all."""


@dataclass(frozen=True)
class Channel:
    """State of one channel, over the pings that were checked."""

    # dB: Its loudest echo over that of the loudest channel; the median of the pings. Minus infinity
    # if the channel is silent
    level_db: float
    noise_db: float  # dB: The quietest tenth of its ranges over its own loudest echo; the median
    heard: int  # In how many pings it heard an echo
    checked: int  # Number of pings that were checked


def channels_of(power: Floats, looks: float) -> list[Channel]:
    """Return the state of each channel. In: power (P, E, R)."""
    heard = (power > threshold_levels(power, looks).total).any(axis=-1).sum(axis=0)
    loud = np.median(power.max(axis=-1), axis=0)
    noise = np.median(np.quantile(power, RANK, axis=-1), axis=0)
    with np.errstate(divide="ignore", invalid="ignore"):
        level = 10.0 * np.log10(loud / loud.max())
        floor = 10.0 * np.log10(noise / loud)
    return [
        Channel(float(one), float(other), int(count), len(power))
        for one, other, count in zip(level, floor, heard, strict=True)
    ]


def faults_of_channels(channels: list[Channel]) -> list[str]:
    """Return the faults of channels that the others contradict, one line each."""
    most = max(channel.heard for channel in channels)
    faults = []
    for number, channel in enumerate(channels):
        if channel.heard < MIN_HEARD_FRACTION * most:
            faults.append(
                f"channel {number} heard echoes in {channel.heard} of {channel.checked} pings, and "
                f"another one in {most}: is its microphone connected? Leave it out with "
                "import.channels and ears.receivers"
            )
        elif channel.level_db < -FAINT_DB:
            faults.append(
                f"channel {number} is {-channel.level_db:.0f} dB fainter than the loudest one: is "
                "its gain right?"
            )
    return faults


def check_channels(recording: Recording, channels: Channels | None) -> None:
    """Refuse a channel that is silent, or equal to another one, in all pings that are looked at."""
    checked = np.linspace(0, len(recording) - 1, min(LOOKED_AT, len(recording))).round().astype(int)
    contents = []
    for ping in np.unique(checked).tolist():
        samples = mixed_channels(np.asarray(recording.read(ping)), channels)
        constant = (samples == samples[:, :1]).all(axis=1)
        contents.append(
            [b"" if flat else row.tobytes() for flat, row in zip(constant, samples, strict=True)]
        )
    of_channels = [b"".join(parts) for parts in zip(*contents, strict=True)]
    if not any(of_channels):
        return
    way_out = "leave it out with import.channels and ears.receivers"
    for number, content in enumerate(of_channels):
        if not content:
            raise InputError(
                f"{recording.path}: channel {number} is silent in all pings; check its cable, or "
                f"{way_out}"
            )
        if (first := of_channels.index(content)) < number:
            raise InputError(
                f"{recording.path}: channels {first} and {number} hold the same samples; check the "
                f"recorder, or {way_out}"
            )


GUARD_SAMPLES = 64
"""Number of samples on both sides of a cut that take up the leakage of a shift by part of a
sample."""
CLIPPED_SAMPLES = 3
"""Number of samples with the same greatest value as a neighbour from which a wave counts as
clipped."""
MIN_CLIPPED_STEPS = 1000
"""Least height of a clipped wave over its quantisation step: a fainter wave repeats values
anyway."""


def cut(samples: NDArray[Any], emission: float, count: int, *, first: int = 0) -> Floats:
    """Return samples from the emission on; zeros where the recording had not begun or has ended.

    In: samples (E, S). Out: (E, N).
    """
    whole = int(np.floor(emission))
    part = emission - whole
    if part > 1.0 - 1e-6:
        whole, part = whole + 1, 0.0
    guard = GUARD_SAMPLES if part > 1e-6 else 0
    begin = whole + first - guard
    length = count + 2 * guard
    low, high = max(begin, 0), min(begin + length, samples.shape[1])
    echo = np.zeros((len(samples), length))
    if high > low:
        echo[:, low - begin : high - begin] = as_float(np.asarray(samples[:, low:high]))
    if not guard:
        return echo
    size = int(scipy.fft.next_fast_len(length, real=True))
    spectrum = np.fft.rfft(echo, size) * np.exp(2j * np.pi * np.fft.rfftfreq(size) * part)
    return np.fft.irfft(spectrum, size)[:, guard : guard + count]


def mixed_channels(samples: NDArray[Any], channels: Channels | None) -> NDArray[Any]:
    """Return the chosen channels (E, S); those that stand together are averaged."""
    if channels is None:
        return samples
    groups = [(one,) if isinstance(one, int) else one for one in channels]
    highest = max(max(group) for group in groups)
    if highest >= len(samples):
        raise InputError(
            f"import.channels: no channel {highest}; the recordings have 0 to {len(samples) - 1}"
        )
    return np.stack([samples[list(group)].mean(axis=0) for group in groups])


@dataclass(frozen=True, eq=False)
class Cutter:
    """Cuts pings out of a recording."""

    recording: Recording  # All pings
    channels: Channels | None = None  # Channels that become receivers; see :func:`mixed_channels`
    delay: float = 0.0  # s: Added to the time of every emission
    gain: ArrayLike = 1.0  # (E,): Factor of each receiver
    # (E, S) or None: Echoes of the surroundings alone, from the emission on, before the factors
    background: Floats | None = None
    # (N,) or None: Waveform whose echoes become those of an impulse; None leaves them as they are
    call: Floats | None = None

    def samples(self, index: int) -> int:
        """Return the number of samples of a ping from the emission on, which may be below one.

        It ends with the file, or when the next call leaves.
        """
        there = float(self.recording.read(index).shape[1])
        if self.recording.until is not None:
            there = min(there, self._sample(float(self.recording.until[index])))
        return int(np.floor(there - self._emission(index)))

    def begins(self, index: int) -> int:
        """Return the first sample after the emission that was recorded."""
        return max(int(np.ceil(-self._emission(index))), 0)

    def _emission(self, index: int) -> float:
        return self._sample(float(self.recording.emission[index]))

    def _sample(self, time: float) -> float:
        # Later sums stay finite where no further call follows.
        seconds = min(time + self.delay, 1e12)
        return round(seconds * self.recording.sampling_rate, 6)

    def echo(self, index: int, count: int, *, first: int = 0) -> Floats:
        """Return the calibrated samples of a ping, (E, N)."""
        whole = count + self._tail
        raw = cut(self.recording.read(index), self._emission(index), whole, first=first)
        if self.background is not None:
            there = self.background[:, first : first + whole]
            raw[:, : there.shape[1]] -= there
        echo = mixed_channels(raw, self.channels) * np.reshape(self.gain, (-1, 1))
        return echo if self.call is None else inverse_filter(echo, self.call)[:, :count]

    @property
    def _tail(self) -> int:
        """Number of samples after the last one that belong to an echo which begins there."""
        return 0 if self.call is None else len(self.call) - 1

    def clipped(self, index: int, first: int, last: int) -> Clipping:
        """Return the shape of a ping's loudest samples, between two samples after the emission."""
        samples = self.recording.read(index)
        begin = round(self._emission(index))
        part = np.asarray(samples[:, max(begin + first, 0) : max(begin + last, 0)])
        step = 0.0 if samples.dtype.kind == "f" else 0.5 ** (8 * samples.dtype.itemsize - 1)
        return Clipping.of(as_float(part), step)

    def digest(self, last: int) -> bytes:
        """Return a hash of the samples that are read of all pings, up to one after the emission."""
        digest = hashlib.sha256()
        for index in range(len(self.recording)):
            samples = self.recording.read(index)
            begin = int(np.floor(self._emission(index)))
            end = begin + last + self._tail + GUARD_SAMPLES
            part = np.asarray(samples[:, max(begin, 0) : max(end, 0)])
            digest.update(np.ascontiguousarray(part).astype(part.dtype.newbyteorder("<")).tobytes())
        return digest.digest()


@dataclass(frozen=True, eq=False)
class Clipping:
    """The greatest value of each channel of a ping, and of its negative, and how often it stays."""

    peak: Floats  # 2 E,: As a fraction of full scale, or in the unit of the recording
    stays: Ints  # 2 E,: Number of samples of that value beside another one
    step: float  # Between two numbers of the recording; 0 of floats

    @classmethod
    def of(cls, samples: Floats, step: float) -> Clipping:
        """Look at samples (E, S)."""
        if not samples.shape[1]:
            return cls(np.zeros(2 * len(samples)), np.zeros(2 * len(samples), np.int64), step)
        both = np.concatenate((samples, -samples))
        peak = both.max(axis=1)
        same = np.pad(both == peak[:, None], ((0, 0), (1, 1)))
        beside = same[:, 1:-1] & (same[:, :-2] | same[:, 2:])
        return cls(peak, beside.sum(axis=1), step)


def clipped_pings(clippings: list[Clipping]) -> Bools:
    """Return the mask (P,) of clipped pings.

    A ping is clipped if one of its channels has three samples or more that equal a neighbour, at a
    value that no ping of this channel exceeds, or at full scale; upward or downward.
    """
    if not clippings:
        return np.zeros(0, dtype=bool)
    peak = np.stack([each.peak for each in clippings])
    stays = np.stack([each.stays for each in clippings])
    step = clippings[0].step
    limit = peak.max(axis=0)
    loud = (peak >= limit - 1.5 * step) & (limit > max(MIN_CLIPPED_STEPS * step, 0.0))
    full = (peak >= 1.0 - 1.5 * step) if step else np.zeros_like(loud)
    return np.asarray(((stays >= CLIPPED_SAMPLES) & (loud | full)).any(axis=1))


def check_numbers(recording: Recording, cutter: Cutter, last: int) -> None:
    """Refuse pings that hold NaN, or whose times lie outside the recording."""

    def refuse(bad: list[int], what: str) -> None:
        if bad:
            more = f" and {len(bad) - 1} more" if len(bad) > 1 else ""
            raise InputError(f"{recording.path}: {recording.labels[bad[0]]}{more}: {what}")

    pings = range(len(recording))
    there = [cutter.samples(index) for index in pings]
    refuse(
        [index for index in pings if there[index] < 1],
        "the time of the emission lies after the end of the recording; check its column time, its "
        "unit and import.time_offset",
    )
    short = [index for index in pings if there[index] < last]
    held = f"has {there[short[0]]} samples after the emission" if short else ""
    refuse(
        short,
        f"{held}, the last range needs {last}; is it cut off? Leave its row out, or lower "
        "spectrogram.range_max",
    )
    floats = recording.read(0).dtype.kind == "f"
    if floats:
        bad = [i for i in pings if not np.isfinite(recording.read(i)).all()]
        refuse(bad, "holds samples that are NaN or infinite")
