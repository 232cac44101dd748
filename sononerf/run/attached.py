# SPDX-License-Identifier: MIT
"""Files that settings name, copied beside what was made with them.

A run or a store with copies works where the measured ear and the call are not at hand.
"""

from __future__ import annotations

from pathlib import Path

from sononerf import storage
from sononerf.errors import InputError
from sononerf.settings.schema import FILE_SECTIONS, Settings

FOLDER = "attached"
"""Where the copies are, in the folder of a run or a store."""


def attach(settings: Settings, folder: Path) -> None:
    """Copy the files that settings name into a folder, if they are not there yet.

    Parameters
    ----------
    settings : Settings
        Of the run or the store.
    folder : Path
        Of the run or the store.

    Raises
    ------
    InputError
        If a file cannot be read.
    StorageError
        If a copy cannot be written.
    """
    for section in FILE_SECTIONS:
        file = getattr(settings, section).file
        if file is None or (copy := _copy_of(file, section, folder)).is_file():
            continue
        try:
            content = file.read_bytes()
        except OSError as error:
            raise InputError(f"{file}: cannot be read ({error.strerror})") from None
        storage.make_folder(copy.parent)
        storage.commit_bytes(copy, content)


def with_attached(settings: Settings, folder: Path) -> Settings:
    """Return the settings with the paths of copies in a folder, where there are copies."""
    found = {}
    for section in FILE_SECTIONS:
        own = getattr(settings, section)
        if own.file is not None and (copy := _copy_of(own.file, section, folder)).is_file():
            found[section] = own.model_copy(update={"file": copy})
    return settings.model_copy(update=found) if found else settings


def _copy_of(file: Path, section: str, folder: Path) -> Path:
    return folder / FOLDER / f"{section}{file.suffix}"
