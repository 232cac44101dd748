# SPDX-License-Identifier: MIT
"""A directivity from a file of any format that is known, told apart by its content."""

from __future__ import annotations

import hashlib
from functools import lru_cache
from pathlib import Path

from sononerf.errors import InputError
from sononerf.head.directivity.csv_table import read_csv
from sononerf.head.directivity.record import Directivity

HDF5_SIGNATURE = b"\x89HDF\r\n\x1a\n"


def read_directivity(path: Path) -> Directivity:
    """Read a SOFA file, a `.mat` file or a table of text; kept until the file changes."""
    return _read(path, content_hash(path))


def content_hash(path: Path) -> str:
    """Return the SHA-256 of a file.

    Raises:
        InputError: If it cannot be read.
    """
    try:
        with path.open("rb") as file:
            return hashlib.file_digest(file, "sha256").hexdigest()
    except FileNotFoundError:
        raise InputError(f"{path}: no such file") from None
    except OSError as error:
        raise InputError(f"{path}: cannot be read ({error.strerror})") from None


@lru_cache(maxsize=4)
def _read(path: Path, content: str) -> Directivity:
    del content  # a changed file is read again
    with path.open("rb") as file:
        start = file.read(128)
    if start.startswith(HDF5_SIGNATURE):
        from sononerf.head.directivity.sofa import read_sofa

        return read_sofa(path)
    # Version 5 says so in its first bytes; 7.3 is HDF5 behind such a text.
    if start.startswith(b"MATLAB "):
        from sononerf.head.directivity.mat_files import read_mat

        return read_mat(path)
    return read_csv(path)
