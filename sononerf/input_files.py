# SPDX-License-Identifier: MIT
"""Checks of files that a user names, made before they are read."""

from __future__ import annotations

import os
import stat
import struct
import warnings
from pathlib import Path
from typing import TYPE_CHECKING, Any

from sononerf.errors import InputError

if TYPE_CHECKING:
    from numpy.typing import NDArray

UNSTATED = 0xFFFF_FFFF
"""Number of bytes in the header of a WAV file above 4 GB, whose size another chunk states."""


def require_regular(path: Path) -> None:
    """Refuse a device, a pipe or a socket, whose reading may never end."""
    mode = path.stat().st_mode
    if stat.S_ISREG(mode) or stat.S_ISDIR(mode):
        return
    kinds = {stat.S_IFIFO: "a pipe", stat.S_IFSOCK: "a socket"}
    kind = kinds.get(stat.S_IFMT(mode), "a device")
    raise InputError(f"{path}: is {kind}, expected a file; save what it gives as a file first")


def require_whole_wav(path: Path) -> None:
    """Refuse a WAV file that states more samples than it holds: memory would be taken for them."""
    size = path.stat().st_size
    with path.open("rb") as file:
        start = file.read(12)
        order = ">" if start[:4] == b"RIFX" else "<"
        long = 0
        while len(header := file.read(8)) == 8 and start[8:12] == b"WAVE":
            name, stated = header[:4], struct.unpack(f"{order}I", header[4:])[0]
            if name == b"ds64":
                sizes = file.read(16)
                long = struct.unpack("<Q", sizes[8:])[0] if len(sizes) == 16 else 0
                file.seek(-len(sizes), os.SEEK_CUR)
            if name == b"data":
                stated = long if stated == UNSTATED and long else stated
                if file.tell() + stated > size:
                    held = size - file.tell()
                    raise InputError(
                        f"{path}: damaged or truncated WAV file: it states {stated} bytes of "
                        f"samples and holds {held}; copy it again"
                    )
            file.seek(stated + stated % 2, os.SEEK_CUR)


def read_wav(path: Path) -> tuple[int, NDArray[Any]]:
    """Return sampling rate (Hz) and samples (S,) or (S, E) of a WAV file, as they are stored."""
    from scipy.io import wavfile

    try:
        require_regular(path)
        with path.open("rb") as file:
            start = file.read(12)
    except OSError as error:
        raise InputError(f"{path}: cannot be read ({error.strerror})") from None
    if start[:4] not in (b"RIFF", b"RIFX", b"RF64") or start[8:12] != b"WAVE":
        raise InputError(f"{path}: no WAV file, whatever its name says")
    require_whole_wav(path)
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
    except Exception as error:  # the error of a damaged file depends on the parser
        said = " ".join(str(error).split())
        raise InputError(f"{path}: damaged or truncated WAV file ({said})") from None
    if rate <= 0:
        raise InputError(f"{path}: has a sampling rate of {rate} Hz; write the file anew")
    return int(rate), samples
