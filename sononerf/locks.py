# SPDX-License-Identifier: MIT
"""The lock of a folder: one process at a time writes into it."""

from __future__ import annotations

import fcntl
import os
import socket
import time
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path

from sononerf import storage
from sononerf.errors import LockedError, StorageError

_LOCK_NAME = ".lock"


def _take(path: Path) -> int | None:
    """Open and lock a lock file; return its descriptor, or None where another holds it."""
    while True:
        descriptor = storage.open_own(path, os.O_RDWR)
        try:
            fcntl.flock(descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)
            # The last owner removes the file at its end, so that the locked file may have no name.
            with suppress(FileNotFoundError):
                if path.stat().st_ino == os.fstat(descriptor).st_ino:
                    return descriptor
        except BlockingIOError:
            os.close(descriptor)
            return None
        except BaseException:
            os.close(descriptor)
            raise
        os.close(descriptor)


def _prepare(folder: Path) -> None:
    """Refuse links, so that no file elsewhere is written; remove dead processes' files.

    The folder itself may be a link, because the user named it.

    Raises:
        StorageError: If there is a link in it or in a folder below it.
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
    """Return whether a process holds a folder, or died while holding it; see :func:`lock`."""
    return (folder / _LOCK_NAME).is_file()


def remove_dead(folder: Path) -> None:
    """Remove the lock that a killed process left in a folder whose work is done."""
    if is_held(folder):
        with suppress(LockedError, StorageError), lock(folder):
            pass


@contextmanager
def lock(folder: Path) -> Iterator[None]:
    """Hold a folder against other processes; the kernel lets go when the process dies.

    Raises:
        LockedError: If another process holds it; the message names its process and start.
        StorageError: If the lock file cannot be written, or the folder holds links.
    """
    storage.make_folder(folder)
    path = folder / _LOCK_NAME
    try:
        descriptor = _take(path)
    except OSError as error:
        raise storage.storage_error("cannot be locked", path, error) from error
    if descriptor is None:
        owner = ""
        with suppress(OSError, UnicodeDecodeError):
            owner = path.read_text(encoding="utf-8").strip()
        raise LockedError(
            f"{folder}: in use by {owner or 'another process'}; wait for it to end, "
            "or choose another folder with --output"
        )
    try:
        _prepare(folder)  # while no other process changes it
        started = time.strftime("%Y-%m-%d %H:%M:%S")
        owner = f"process {os.getpid()} on {socket.gethostname()} since {started}\n"
        os.ftruncate(descriptor, 0)
        os.pwrite(descriptor, owner.encode(), 0)
        yield
    finally:
        with suppress(OSError):
            path.unlink()
        os.close(descriptor)
