# SPDX-License-Identifier: MIT
"""Sound files: WAV through SciPy; FLAC and others through soundfile, where it is installed."""

from __future__ import annotations

import struct
import warnings
from functools import lru_cache
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.io import wavfile

from sononerf.errors import InputError

WAV, OTHERS = (".wav",), (".flac", ".ogg", ".aiff", ".aif", ".w64", ".caf")
SUFFIXES = (*WAV, *OTHERS)


def read_audio(path: Path) -> tuple[float, NDArray[Any]]:
    """Read a sound file.

    Args:
        path: Of a kind in :data:`SUFFIXES`; a WAV is mapped, not loaded, where it can be.

    Returns:
        sampling_rate (Hz): As the file says.
        samples (E, S): Integers reach from one end of their type to the other.

    Raises:
        InputError: If it is missing, truncated, empty, or of another kind than its name says.
    """
    if not path.is_file():
        raise InputError(f"{path}: no such file")
    stamp = path.stat()
    return _read(path, stamp.st_mtime_ns, stamp.st_size)


@lru_cache(maxsize=2)  # one long file holds many pings
def _read(path: Path, *stamp: int) -> tuple[float, NDArray[Any]]:
    """Read a file as it was at a time and of a size."""
    del stamp
    rate, samples = (_wav if path.suffix.lower() in WAV else _other)(path)
    if samples.ndim == 1:
        samples = samples[:, None]
    if samples.ndim != 2 or not samples.size:
        raise InputError(f"{path}: holds no samples")
    return float(rate), samples.T


def _wav(path: Path) -> tuple[float, NDArray[Any]]:
    with path.open("rb") as file:
        start = file.read(12)
    if start[:4] not in (b"RIFF", b"RIFX", b"RF64") or start[8:12] != b"WAVE":
        raise InputError(f"{path}: no WAV file, whatever its name says")
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("error", wavfile.WavFileWarning)
            # Chunks of other programs are no fault.
            warnings.filterwarnings("ignore", message="Chunk .non-data. not understood")
            try:
                rate, samples = wavfile.read(path, mmap=True)
            except ValueError as error:
                if "mmap" not in str(error):
                    raise
                rate, samples = wavfile.read(path)  # 24 bits cannot be mapped
    except (ValueError, wavfile.WavFileWarning, struct.error, EOFError, OverflowError) as error:
        said = " ".join(str(error).split())
        raise InputError(f"{path}: damaged or truncated WAV file ({said})") from None
    return rate, samples


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


def as_float(samples: NDArray[Any]) -> NDArray[np.float64]:
    """Return samples as floats; integers as fractions of the greatest that their type holds."""
    kind = samples.dtype
    if kind.kind == "u":
        middle = 2.0 ** (8 * kind.itemsize - 1)
        return (samples.astype(np.float64) - middle) / middle
    if kind.kind == "i":
        return samples.astype(np.float64) / 2.0 ** (8 * kind.itemsize - 1)
    return samples.astype(np.float64)
