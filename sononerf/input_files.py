# SPDX-License-Identifier: MIT
"""Checks of files that a user names, made before they are read."""

from __future__ import annotations

import os
import stat
import struct
import subprocess
import sys
from pathlib import Path

from sononerf.errors import InputError

UNSTATED = 0xFFFF_FFFF
"""Number of bytes in the header of a WAV file above 4 GB, whose size another chunk states."""
MATLAB_SECONDS, MATLAB_SPEED = 2, 1e5
"""Processor time allowed for a MATLAB file, s, and least reading speed allowed, bytes/s. Importing
SciPy takes 0.5 s. Arrays are read at 75 MB/s or more, small structs at 0.2 MB/s."""


def require_regular(path: Path) -> None:
    """Refuse a device, a pipe or a socket, whose reading may never end.

    Raises:
        InputError: If it is one.
        OSError: If it is not there, or may not be looked at.
    """
    mode = path.stat().st_mode
    if stat.S_ISREG(mode) or stat.S_ISDIR(mode):
        return
    kinds = {stat.S_IFIFO: "a pipe", stat.S_IFSOCK: "a socket"}
    kind = kinds.get(stat.S_IFMT(mode), "a device")
    raise InputError(f"{path}: is {kind}, expected a file; save what it gives as a file first")


def require_sound_matlab(path: Path) -> None:
    """Refuse a MATLAB 5 file that crashes its reader or takes too long; a process tries it.

    SciPy 1.17 reads beyond its tables where the type of an element is damaged, and reads millions
    of elements that are not there where a size is. What it refuses with an error passes: whoever
    reads the file has that error too.

    Raises:
        InputError: If it does.
    """
    seconds = round(MATLAB_SECONDS + path.stat().st_size / MATLAB_SPEED)
    script = (
        "import resource, scipy.io, sys; s = int(sys.argv[2]); "
        "resource.setrlimit(resource.RLIMIT_CPU, (s, s)); scipy.io.loadmat(sys.argv[1])"
    )
    read = subprocess.run(
        [sys.executable, "-I", "-c", script, str(path), str(seconds)],
        capture_output=True,
        check=False,
    )
    if read.returncode < 0:
        raise InputError(
            f"{path}: damaged MATLAB file, which crashes its reader or takes it more than "
            f"{seconds} s; save it again"
        )


def require_whole_wav(path: Path) -> None:
    """Refuse a WAV file that states more samples than it holds: memory would be taken for them.

    Raises:
        InputError: If it is one. A file of another kind passes.
    """
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
