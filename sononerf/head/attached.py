# SPDX-License-Identifier: MIT
"""Files of a head, a directivity or a call, that are copied into the folder of a run or a store."""

from __future__ import annotations

from pathlib import Path
from typing import Any, Protocol

from sononerf import storage
from sononerf.errors import InputError
from sononerf.settings.schema import FILE_SECTIONS, CallSettings, EarSettings

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
    found = {}
    for section in FILE_SECTIONS:
        own = getattr(head, section)
        if own.file is not None and (copy := _copy_of(own.file, section, folder)).is_file():
            found[section] = own.model_copy(update={"file": copy})
    return found


def _copy_of(file: Path, section: str, folder: Path) -> Path:
    return folder / FOLDER / f"{section}{file.suffix}"
