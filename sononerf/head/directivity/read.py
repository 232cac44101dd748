# SPDX-License-Identifier: MIT
"""Reading of a directivity from a file, whose format its content shows; tables of text."""

from __future__ import annotations

import csv
import hashlib
import logging
from functools import lru_cache
from pathlib import Path
from typing import Any

import numpy as np

from sononerf.array_types import Floats
from sononerf.errors import InputError
from sononerf.head.directivity.record import MOST_RECEIVERS, Directivity, unit_vectors
from sononerf.input_files import require_regular

logger = logging.getLogger("sononerf")

MOST_BYTES = 500_000_000
ANGLES = ("azimuth_deg", "elevation_deg")
EMITTER = -1


def read_csv(path: Path) -> Directivity:
    """Read a table of gains.

    Columns ``azimuth_deg`` (to the left), ``elevation_deg`` (up), ``frequency_hz``, ``gain``
    (linear) or ``gain_db``, and perhaps ``receiver``: a number from 0 on, or ``emitter``. Every
    receiver has every direction at every frequency, once, in any order.
    """
    if path.stat().st_size > MOST_BYTES:
        raise InputError(f"{path}: larger than {MOST_BYTES} bytes")
    try:
        with path.open(encoding="utf-8-sig", newline="") as file:
            return _table(path, _rows(path, csv.reader(file)))
    except (UnicodeDecodeError, csv.Error) as error:
        raise InputError(
            f"{path}: no SOFA file, no .mat file and no table of text ({error})"
        ) from None


def _rows(path: Path, lines: Any) -> Floats:
    """Return receiver, azimuth, elevation, frequency, linear gain (N, 5)."""
    names = [name.strip().lower() for name in next(lines, [])]
    missing = [name for name in (*ANGLES, "frequency_hz") if name not in names]
    gains = [name for name in ("gain", "gain_db") if name in names]
    if missing or len(gains) != 1:
        raise InputError(
            f"{path}: columns {', '.join(names)[:200] or 'none'}; expected azimuth_deg, "
            "elevation_deg, frequency_hz, one of gain and gain_db, and perhaps receiver"
        )
    where = [names.index(name) for name in (*ANGLES, "frequency_hz", gains[0])]
    receiver = names.index("receiver") if "receiver" in names else None
    rows = []
    for line in lines:
        if not any(cell.strip() for cell in line):
            continue
        try:
            if len(line) != len(names):
                raise ValueError(f"{len(line)} values, expected {len(names)}")
            number = 0 if receiver is None else _receiver(line[receiver].strip().lower())
            rows.append((number, *(float(line[column]) for column in where)))
        except ValueError as error:
            raise InputError(f"{path}: line {lines.line_num}: {error}") from None
    values = np.array(rows, dtype=np.float64).reshape(-1, 5)
    wrong = np.flatnonzero(~np.isfinite(values).all(axis=1) | (np.abs(values[:, 2]) > 90.0))
    if len(wrong):
        raise InputError(
            f"{path}: data line {wrong[0] + 1}: a value is NaN or infinite, or an elevation is "
            "beyond 90 degrees"
        )
    if gains[0] == "gain_db":
        values[:, 4] = 10.0 ** (values[:, 4].clip(max=200.0) / 20.0)
    return values


def _receiver(text: str) -> int:
    if text == "emitter":
        return EMITTER
    if not text.isdecimal() or int(text) >= MOST_RECEIVERS:
        raise ValueError(f"receiver {text!r}, expected a number from 0 on, or emitter")
    return int(text)


def _table(path: Path, rows: Floats) -> Directivity:
    if not len(rows):
        raise InputError(f"{path}: holds no gains")
    receivers, which = np.unique(rows[:, 0], return_inverse=True)
    # Angles count to a millionth of a degree.
    angles, direction = np.unique(rows[:, 1:3].round(6), axis=0, return_inverse=True)
    frequency, row = np.unique(rows[:, 3], return_inverse=True)
    shape = (len(receivers), len(angles), len(frequency))
    place = np.ravel_multi_index((which, direction.reshape(-1), row), shape)
    times = np.bincount(place, minlength=int(np.prod(shape)))
    if (times != 1).any():
        first = int(np.flatnonzero(times != 1)[0])
        e, m, f = np.unravel_index(first, shape)
        name = "emitter" if receivers[e] == EMITTER else f"receiver {receivers[e]:g}"
        raise InputError(
            f"{path}: the gain of {name} at azimuth {angles[m, 0]:g}, elevation {angles[m, 1]:g}, "
            f"{frequency[f]:g} Hz stands there {times[first]} times, expected once"
        )
    gains = np.zeros(place.size)
    gains[place] = rows[:, 4]
    gains = gains.reshape(shape)
    beam = gains[0] if receivers[0] == EMITTER else None
    hearing = receivers != EMITTER
    if not np.array_equal(receivers[hearing], np.arange(hearing.sum())) or not hearing.any():
        raise InputError(
            f"{path}: the receivers are {', '.join(f'{n:g}' for n in receivers[hearing]) or 'none'}"
            "; expected 0, 1, ... without a gap"
        )
    directions = unit_vectors(*np.radians(angles.T))
    return Directivity(str(path), directions, frequency, gains[hearing], beam)


HDF5_SIGNATURE = b"\x89HDF\r\n\x1a\n"


def read_directivity(path: Path) -> Directivity:
    """Read a SOFA file, a `.mat` file or a table of text; kept until the file changes."""
    return _read(path, content_hash(path))


def content_hash(path: Path) -> str:
    """Return the SHA-256 of a file."""
    try:
        require_regular(path)
        with path.open("rb") as file:
            return hashlib.file_digest(file, "sha256").hexdigest()
    except FileNotFoundError:
        raise InputError(f"{path}: no such file") from None
    except OSError as error:
        raise InputError(f"{path}: cannot be read ({error.strerror})") from None


@lru_cache(maxsize=4)
def _read(path: Path, content: str) -> Directivity:
    del content  # a changed file is read again
    found = _of_its_kind(path)
    if found.is_flat:
        logger.warning(
            "%s: the directivity is measured in one plane alone; beside it gains fade to zero, so "
            "echoes from there count as silent; measure other elevations too, or set "
            "ears.directivity=omnidirectional",
            path,
        )
    return found


def _of_its_kind(path: Path) -> Directivity:
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
