# SPDX-License-Identifier: MIT
"""Checksums of the files of a run, so that a damaged or changed file is never taken for a result.

A run's ``checksums.jsonl`` gets a line with the SHA-256 of each file before the file takes its
name. The newest line and the one before it are therefore both valid: a process that dies in between
leaves the old file. Three kinds are left out: the previews of epochs are only looked at, and the
files of TensorBoard and Lightning's checkpoints hold checksums of their own.
"""

from __future__ import annotations

import hashlib
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from sononerf import storage
from sononerf.errors import InputError

NAME = "checksums.jsonl"
_OTHERS = ("epochs", "tensorboard")
_CHECKPOINTS = ".ckpt"


@contextmanager
def recorded(folder: Path) -> Iterator[None]:
    """Record the SHA-256 of every file that is written below a folder, and every removal."""
    place = folder.resolve()

    def record(path: Path, content: Path | None) -> None:
        target = path.resolve()
        if not target.is_relative_to(place):
            return
        name = target.relative_to(place)
        hidden = any(part.startswith(".") for part in name.parts)
        if hidden or name.parts[0] in _OTHERS or _CHECKPOINTS in name.suffixes:
            return
        digest = None if content is None else _digest(content)
        storage.append_record(place / NAME, {"file": name.as_posix(), "sha256": digest})

    with storage.watched(record):
        yield


def _digest(file: Path) -> str:
    with file.open("rb") as opened:
        return hashlib.file_digest(opened, "sha256").hexdigest()


def _valid(folder: Path) -> dict[str, tuple[str | None, str | None]]:
    """Return the older and the newest checksum of each file; None stands for no file."""
    valid: dict[str, tuple[str | None, str | None]] = {}
    for record in storage.read_records(folder / NAME):
        name = str(record.get("file"))
        _, older = valid.get(name, (None, None))
        valid[name] = (older, record.get("sha256"))
    return valid


def require_recorded(folder: Path, file: Path, remedy: str) -> None:
    """Refuse a file of a run that is not as the run recorded it.

    A file that no checksum is known of, as in runs of older versions, passes.

    Args:
        folder: Folder of the run.
        file: In this folder, or elsewhere, where nothing is recorded.
        remedy: Advice to the user.

    Raises:
        InputError: If its content is another one.
    """
    if not file.is_relative_to(folder) or not file.is_file():
        return
    valid = _valid(folder).get(file.relative_to(folder).as_posix())
    if valid is not None and _digest(file) not in valid:
        raise InputError(f"{file}: damaged, or changed since it was written; {remedy}")


def count(folder: Path) -> int:
    """Return of how many files of a run a checksum is known."""
    return sum(newest is not None for _, newest in _valid(folder).values())


def differing(folder: Path) -> list[str]:
    """Return the names of the files of a run that are missing or differ from their checksum."""
    found = []
    for name, (older, newest) in sorted(_valid(folder).items()):
        file = folder / name
        if not file.is_file():
            is_wrong = newest is not None
        else:
            is_wrong = _digest(file) not in (older, newest)
        if is_wrong:
            found.append(name)
    return found
