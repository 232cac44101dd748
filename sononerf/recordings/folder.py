# SPDX-License-Identifier: MIT
"""Format ``recordings``: a folder of sound files and a table of poses.

One file per ping (column ``file``), or one long file (``import.file``, or the only one there) with
the time of each emission in the column ``time``. A file is WAV, FLAC, ``.npz`` or HDF5; the last
two hold ``waveform`` (E, S) and ``sampling_rate``.
"""

from __future__ import annotations

import re
from collections.abc import Collection
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from sononerf.errors import InputError
from sononerf.numerics import Floats
from sononerf.recordings import audio, readers
from sononerf.recordings.audio import Recording
from sononerf.recordings.pose_tables import Columns, read_table
from sononerf.settings.import_schema import ImportSettings

SUFFIXES = (*audio.SUFFIXES, *readers.SUFFIXES)


def read_sound(path: Path, settings: ImportSettings) -> tuple[float, NDArray[Any]]:
    """Read one file of any kind: its sampling rate (Hz) and samples (E, S)."""
    suffix = path.suffix.lower()
    if suffix in audio.SUFFIXES:
        rate, samples = audio.read_audio(path)
        wanted = settings.sampling_rate
        # Recorders of ultrasound often write a tenth of their rate, so that it can be heard.
        return (rate if wanted is None else wanted), samples
    if suffix not in readers.SUFFIXES:
        raise InputError(f"{path}: unknown kind of file; known: {', '.join(SUFFIXES)}")
    rate, samples = readers.waveform_of(path, readers.read_arrays(path), settings)
    samples = samples[None] if samples.ndim == 1 else samples
    if samples.ndim != 2 or not samples.size:
        raise InputError(
            f"{path}: waveform has shape {samples.shape}, expected (receivers, samples)"
        )
    return rate, samples


def read_folder(source: Path, settings: ImportSettings, apart: Collection[Path] = ()) -> Recording:
    """Read the format ``recordings``."""
    table = source if source.is_file() else source / settings.poses
    if not table.is_file():
        raise InputError(f"{table}: no table of poses; write one line per ping")
    folder = table.parent if source.is_file() else source
    columns = read_table(table, settings)
    apart = {(folder / path).resolve() for path in (*_others(settings), *apart)}
    files = _files(folder, columns, settings, apart)
    keep, further = _present(folder, files, columns, settings, apart)
    dropped = len(columns) - len(keep)
    columns = columns.take(keep)
    files = [files[row] for row in keep]
    rate, first = read_sound(files[0], settings)
    for path in dict.fromkeys(files):
        other, samples = read_sound(path, settings)
        if other != rate or len(samples) != len(first):
            raise InputError(
                f"{path}: {len(samples)} channels at {other:g} Hz, {files[0].name} has "
                f"{len(first)} at {rate:g} Hz; all must have the same"
            )
    times = columns.values.get("time")
    if times is None and len(set(files)) < len(files):
        twice = next(path for path in files if files.count(path) > 1)
        raise InputError(
            f"{table}: {files.count(twice)} pings in {twice.name} and no column time; add the time "
            "of each emission, s from the start of the file"
        )

    def read(index: int) -> NDArray[Any]:
        return read_sound(files[index], settings)[1]

    notes = [f"{dropped} poses without a recording are left out"] if dropped else []
    if further:
        listed = ", ".join(path.name for path in further[:3])
        notes.append(f"{listed}{' ...' if len(further) > 3 else ''}: no pings, as their names say")
    single = len(set(files)) == len(files) and len(files) > 1
    names = [
        path.name if single else f"{path.name}, row {row + 1}"
        for row, path in zip(keep, files, strict=True)
    ]
    return Recording(
        path=table,
        sampling_rate=rate,
        labels=tuple(names),
        emission=np.zeros(len(files)) if times is None else times,
        read=read,
        columns=columns,
        notes=tuple(notes),
        until=None if times is None else _next_call(table, files, times, keep),
    )


def _next_call(table: Path, files: list[Path], times: Floats, rows: list[int]) -> Floats:
    """Return the emission of the next call in the same file, (P,) s; infinite if none."""
    until = np.full(len(files), np.inf)
    for path in dict.fromkeys(files):
        inside = np.array([row for row, other in enumerate(files) if other == path])
        order = inside[np.argsort(times[inside], kind="stable")]
        apart = np.diff(times[order])
        if (apart == 0.0).any():
            first = int(np.flatnonzero(apart == 0.0)[0])
            one, other = sorted(rows[i] + 1 for i in order[first : first + 2])
            raise InputError(
                f"{table}: rows {one} and {other} have the same time of emission in {path.name}; "
                "each call has a time of its own"
            )
        until[order[:-1]] = times[order[1:]]
    return until


def _others(settings: ImportSettings) -> set[Path]:
    """Return the files of the settings that are no pings."""
    reference = [settings.reference.file] if settings.reference is not None else []
    return {path for path in (settings.background, *reference) if path is not None}


def _files(
    folder: Path, columns: Columns, settings: ImportSettings, apart: Collection[Path]
) -> list[Path]:
    """Return the file of each row."""
    if "file" in columns.texts:
        empty = [row for row, name in enumerate(columns.texts["file"]) if not name]
        if empty:
            raise InputError(f"{columns.where}: column file of row {empty[0] + 1} is empty")
        return [folder / name for name in columns.texts["file"]]
    if settings.file is not None:
        return [folder / settings.file] * len(columns)
    sounds = _sounds(folder, apart)
    if len(sounds) == 1:
        return sounds * len(columns)
    raise InputError(
        f"{columns.where}: no column file, and {len(sounds)} recordings in {folder}; name each "
        "ping's file in a column file, or the long one in import.file"
    )


def _sounds(folder: Path, apart: Collection[Path]) -> list[Path]:
    return [
        path
        for path in sorted(folder.iterdir())
        if path.suffix.lower() in SUFFIXES and path.resolve() not in apart
    ]


def _pattern(path: Path) -> str:
    """Return a file's name with a mark in place of its numbers: pings differ in these alone."""
    return re.sub(r"\d+", "#", path.name)


def _present(
    folder: Path,
    files: list[Path],
    columns: Columns,
    settings: ImportSettings,
    apart: Collection[Path],
) -> tuple[list[int], list[Path]]:
    """Return the rows whose file is there, and the recordings that are no pings.

    A row without a file is refused or skipped, as set. A recording without a row is refused if it
    is named like a ping.
    """
    keep = [row for row, path in enumerate(files) if path.is_file()]
    if settings.missing == "skip":
        if not keep:
            raise InputError(f"{columns.where}: none of its {len(files)} recordings is there")
        return keep, []
    way_out = "correct the table, or set import.missing=skip"
    lost = [path for path in dict.fromkeys(files) if not path.is_file()]
    if lost:
        raise InputError(
            f"{columns.where}: {len(lost)} poses have no recording, such as {lost[0].name}; "
            f"{way_out}"
        )
    used = {path.resolve() for path in files}
    folders = {path.parent for path in files}
    rest = [p for place in folders for p in _sounds(place, apart) if p.resolve() not in used]
    patterns = {_pattern(path) for path in files}
    unused = [path for path in rest if _pattern(path) in patterns]
    if unused:
        raise InputError(
            f"{folder}: {len(unused)} recordings have no pose, such as {unused[0].name}; {way_out}"
        )
    return keep, rest
