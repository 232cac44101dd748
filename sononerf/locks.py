# SPDX-License-Identifier: MIT
"""The lock of a folder: one process at a time writes into it."""

from __future__ import annotations

import os
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from filelock import FileLock, Timeout

from sononerf import storage
from sononerf.errors import LockedError, StorageError

PATIENCE_SECONDS = 1.0
"""Time to wait for a lock, s; a process that asks whether it is held has it for an instant."""


def _prepare(folder: Path) -> None:
    """Refuse links, so that no file elsewhere is written; remove dead processes' files.

    The folder itself may be a link, because the user named it.
    """
    waiting = [folder]
    while waiting:
        place = waiting.pop()
        storage.clean_leftovers(place)
        with os.scandir(place) as entries:
            for entry in entries:
                if entry.is_symlink():
                    raise StorageError(
                        f"{entry.path}: is a link to {Path(entry.path).readlink()}, so that files "
                        "elsewhere would be written; put the file or folder itself in its place"
                    )
                if entry.is_dir():
                    waiting.append(Path(entry.path))


def is_held(folder: Path) -> bool:
    """Return whether a living process holds a folder; see :func:`lock`."""
    path = folder / storage.LOCK
    if not path.is_file():
        return False
    try:
        with FileLock(path, timeout=0):
            return False
    except Timeout:
        return True


@contextmanager
def lock(folder: Path) -> Iterator[None]:
    """Hold a folder against other processes; the kernel lets go when the process dies."""
    storage.make_folder(folder)
    held = FileLock(folder / storage.LOCK, timeout=PATIENCE_SECONDS)
    try:
        held.acquire()
    except Timeout:
        raise LockedError(
            f"{folder}: in use by another process; wait for it to end, or choose another folder "
            "with --output"
        ) from None
    except OSError as error:
        raise storage.storage_error("cannot be locked", folder / storage.LOCK, error) from error
    try:
        _prepare(folder)  # while no other process changes it
        yield
    finally:
        held.release()
