# SPDX-License-Identifier: MIT
"""A recording, and sound files: WAV by SciPy; FLAC and others by soundfile, if it is installed."""

from __future__ import annotations

import io
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from functools import lru_cache
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.io import wavfile

from sononerf.echoes.layout import SPLITS
from sononerf.errors import InputError
from sononerf.geometry.poses import Poses, euler_from_rotation
from sononerf.numerics import Floats
from sononerf.recordings.pose_tables import Columns
from sononerf.storage import read_wav

WAV, OTHERS = (".wav",), (".flac", ".ogg", ".aiff", ".aif", ".w64", ".caf")
SUFFIXES = (*WAV, *OTHERS)


def read_audio(path: Path) -> tuple[float, NDArray[Any]]:
    """Read a sound file.

    Out: sampling_rate (Hz), samples (E, S).
    """
    if not path.is_file():
        raise InputError(f"{path}: no such file")
    stamp = path.stat()
    return _read(path, stamp.st_mtime_ns, stamp.st_size)


@lru_cache(maxsize=2)  # one long file holds many pings
def _read(path: Path, *stamp: int) -> tuple[float, NDArray[Any]]:
    """Read a file as it was at a time and of a size."""
    del stamp
    rate, samples = (read_wav if path.suffix.lower() in WAV else _other)(path)
    if samples.ndim == 1:
        samples = samples[:, None]
    if samples.ndim != 2 or not samples.size:
        raise InputError(f"{path}: holds no samples")
    return float(rate), samples.T


def _other(path: Path) -> tuple[float, NDArray[Any]]:
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
            return file.samplerate, samples
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
    """Return the table that the format ``recordings`` reads.

    In: split ((P,) int8).
    """
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
