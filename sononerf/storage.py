# SPDX-License-Identifier: MIT
"""Write, lock and read files: beside the target, flushed, renamed; one lock per folder."""

from __future__ import annotations

import errno
import json
import os
import re
import shutil
import stat
import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import TYPE_CHECKING, Any, BinaryIO

from filelock import FileLock, Timeout

from sononerf.errors import InputError, LockedError, NumericalError, StorageError

if TYPE_CHECKING:
    pass

LOCK = ".lock"
"""Name of the file by which a folder is locked; it stays there."""
_LEFTOVER = re.compile(r"\.(?P<name>.+)\.(?P<pid>\d+)(?:-\d+)?\.tmp", re.DOTALL)
WAYS_OUT = {
    errno.ELOOP: "is a link; put the file itself in its place",
    errno.ENOSPC: "the disk is full; free space, then give the same command again",
    errno.EDQUOT: "the quota is used up; free space, then give the same command again",
    errno.EFBIG: "the file would pass the size limit; raise it (ulimit -f)",
    errno.EROFS: "the file system is read-only; choose another folder (--output, data.store)",
    errno.EACCES: "permission denied; change its permissions or choose another folder",
    errno.EPERM: "not permitted; change its permissions or choose another folder",
    errno.ENOTDIR: "a part of the path is a file; choose another folder",
    errno.EIO: "the disk reports an input/output error; check the disk, choose another folder",
    errno.ENAMETOOLONG: "the name is too long; choose a shorter one",
}
"""Advice about an operating system's refusal, by its error number."""


def storage_error(what: str, path: Path, error: OSError) -> StorageError:
    """Return one line for an operating system's refusal: action, path, reason, remedy."""
    reason = error.strerror or str(error)
    way_out = WAYS_OUT.get(error.errno or 0, f"{reason}; check the path and the disk")
    return StorageError(f"{path}: {what}: {way_out}")


def temporary_beside(path: Path) -> Path:
    """Return the name, beside ``path``, under which this thread writes before it renames."""
    owner = str(os.getpid())
    if threading.current_thread() is not threading.main_thread():
        owner += f"-{threading.get_native_id()}"
    return path.with_name(f".{path.name}.{owner}.tmp")


def sync_folder(folder: Path) -> None:
    """Make the names in a folder durable; without it a rename may not survive a power cut."""
    descriptor = os.open(folder, os.O_RDONLY)
    try:
        os.fsync(descriptor)
    finally:
        os.close(descriptor)


def _missing_folders(folder: Path) -> list[Path]:
    """Return the folders that have to be created for a folder, innermost first."""
    missing = []
    while not folder.is_dir():
        missing.append(folder)
        if folder.parent == folder:
            break
        folder = folder.parent
    return missing


def _make_folder(folder: Path) -> None:
    missing = _missing_folders(folder)
    for new in reversed(missing):
        with suppress(FileExistsError):  # another process was faster
            os.mkdir(new)  # noqa: PTH102 - the fault tests replace the calls of `os`
        sync_folder(new.parent)
    if missing and not folder.is_dir():
        raise NotADirectoryError(errno.ENOTDIR, "not a folder", str(folder))


def make_folder(folder: Path) -> None:
    """Create a folder and its parents, durably; nothing happens where it is there already."""
    try:
        _make_folder(folder)
    except OSError as error:
        raise storage_error("cannot create the folder", folder, error) from error


def commit(path: Path, writer: Callable[[BinaryIO], object]) -> None:
    """Write a file so that its old or its new content is complete, even after a crash.

    The content goes to a temporary file beside the target, is flushed and fsynced, takes the
    target's name, and the folder is fsynced. Missing folders are created.
    """
    temporary = temporary_beside(path)
    try:
        _make_folder(path.parent)
        try:
            with open(temporary, "wb") as file:  # noqa: PTH123 - see `_make_folder`
                writer(file)
                file.flush()
                os.fsync(file.fileno())
            os.replace(temporary, path)  # noqa: PTH105
            sync_folder(path.parent)
        except BaseException:
            with suppress(OSError):
                temporary.unlink(missing_ok=True)
            raise
    except OSError as error:
        raise storage_error("cannot be written", path, error) from error


def commit_bytes(path: Path, data: bytes | memoryview) -> None:
    """Commit bytes; see :func:`commit`."""
    commit(path, lambda file: file.write(data))


def commit_text(path: Path, text: str) -> None:
    """Commit text as UTF-8 with unchanged line ends; see :func:`commit`."""
    commit_bytes(path, text.encode())


def _plain(value: Any) -> Any:
    """Turn NumPy's scalars and arrays into plain numbers and lists without importing NumPy."""
    if isinstance(value, Path):
        return str(value)
    if hasattr(value, "tolist"):
        return value.tolist()
    raise TypeError(f"{type(value).__name__} is no plain data")


def to_json(data: Any, *, indent: int | None = None, sort_keys: bool = False) -> str:
    """Return plain data, NumPy's scalars and arrays as JSON text."""
    return json.dumps(
        data,
        indent=indent,
        sort_keys=sort_keys,
        allow_nan=False,
        ensure_ascii=False,
        default=_plain,
        separators=(",", ":") if indent is None else None,
    )


def commit_json(path: Path, data: Any) -> None:
    """Commit plain data as JSON; see :func:`commit`."""
    try:
        text = to_json(data, indent=2)
    except ValueError as error:
        raise NumericalError(f"{path}: not written: a value is NaN or infinite") from error
    commit_text(path, text + "\n")


def read_json(path: Path) -> Any:
    """Read a JSON file."""
    try:
        return json.loads(path.read_bytes().decode())
    except FileNotFoundError:
        raise InputError(f"{path}: no such file") from None
    except OSError as error:
        raise InputError(f"{path}: cannot be read ({error.strerror})") from None
    except (ValueError, RecursionError) as error:
        raise InputError(f"{path}: damaged, or no JSON ({error})") from None


def remove_file(path: Path) -> None:
    """Remove a file, durably; a missing file is no error."""
    try:
        path.unlink()
        sync_folder(path.parent)
    except FileNotFoundError:
        return  # its folder may be missing too
    except OSError as error:
        raise storage_error("cannot be removed", path, error) from error


def _is_alive(pid: int) -> bool:
    try:
        os.kill(pid, 0)
    except (ProcessLookupError, OverflowError):
        return False
    except PermissionError:
        return True
    return True


def clean_leftovers(folder: Path) -> None:
    """Remove unfinished files of dead processes from a folder: ``.<name>.<pid>.tmp``."""
    if not folder.is_dir():
        return
    with os.scandir(folder) as entries:
        left = [Path(entry.path) for entry in entries if _LEFTOVER.fullmatch(entry.name)]
    for path in left:
        match = _LEFTOVER.fullmatch(path.name)
        if match is None or _is_alive(int(match["pid"])):
            continue
        # Leftovers cost space, nothing else: one that cannot go is no reason to stop.
        if path.is_dir() and not path.is_symlink():
            shutil.rmtree(path, ignore_errors=True)
        else:
            with suppress(OSError):
                path.unlink()


def probe_writable(folder: Path) -> list[Path]:
    """Create a folder and prove that files can be written there, before anything expensive."""
    created = _missing_folders(folder)
    probe = folder / ".probe"
    try:
        commit_bytes(probe, b"sononerf\n" * 512)
        remove_file(probe)
    except BaseException as error:
        with suppress(OSError):
            probe.unlink(missing_ok=True)
        remove_if_empty(created)
        # The user knows the folder, not the probe file.
        if isinstance(error, StorageError) and isinstance(error.__cause__, OSError):
            raise storage_error("cannot be written", folder, error.__cause__) from error.__cause__
        raise
    return created


def remove_if_empty(folders: list[Path]) -> None:
    """Remove folders that nothing but a lock came into, in the order given."""
    for folder in folders:
        with suppress(OSError):  # something did
            if [path.name for path in folder.iterdir()] == [LOCK]:
                (folder / LOCK).unlink()
            folder.rmdir()


PATIENCE_SECONDS = 1.0
"""Time to wait for a lock, s; a process that asks whether it is held has it for an instant."""


def _prepare(folder: Path) -> None:
    """Refuse links, so that no file elsewhere is written; remove dead processes' files.

    The folder itself may be a link, because the user named it.
    """
    waiting = [folder]
    while waiting:
        place = waiting.pop()
        clean_leftovers(place)
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
    """Return True if a living process holds a folder; see :func:`lock`."""
    path = folder / LOCK
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
    make_folder(folder)
    held = FileLock(folder / LOCK, timeout=PATIENCE_SECONDS)
    try:
        held.acquire()
    except Timeout:
        raise LockedError(
            f"{folder}: in use by another process; wait for it to end, or choose another folder "
            "with --output"
        ) from None
    except OSError as error:
        raise storage_error("cannot be locked", folder / LOCK, error) from error
    try:
        _prepare(folder)  # while no other process changes it
        yield
    finally:
        held.release()


def require_regular(path: Path) -> None:
    """Refuse a device, a pipe or a socket, whose reading may never end."""
    mode = path.stat().st_mode
    if stat.S_ISREG(mode) or stat.S_ISDIR(mode):
        return
    kinds = {stat.S_IFIFO: "a pipe", stat.S_IFSOCK: "a socket"}
    kind = kinds.get(stat.S_IFMT(mode), "a device")
    raise InputError(f"{path}: is {kind}, expected a file; save what it gives as a file first")


BEGINNINGS = {
    b"version https://git-lfs": "a pointer of Git LFS; fetch the file that it stands for",
    b"<!doctype html": "a web page",
    b"<!DOCTYPE html": "a web page",
    b"<html": "a web page",
    b"PK\3\4": "a ZIP archive, as of a spreadsheet",
    b"\x1f\x8b": "compressed by gzip",
    b"\x89HDF": "HDF5",
    b"MATLAB ": "a MATLAB file; save it as HDF5 (h5create, h5write) with pings along the "
    "last dimension, or see the formats sonotracelab and sononerf-matlab",
    b"fLaC": "FLAC",
    b"OggS": "Ogg",
    b"FORM": "AIFF",
    b"caff": "CAF",
    b"riff\x2e\x91\xcf\x11": "Wave64",
}
"""What a file is by its first bytes: what others end up with under a wrong name."""


def wrong_kind(path: Path, kind: str) -> InputError:
    """Return the error of a file that is not of a kind; it says what the file is, if that shows."""
    name = name_by_content(path)
    said = f"; it is {name}" if name else ", whatever its name says"
    return InputError(f"{path}: no {kind}{said}")


def name_by_content(path: Path) -> str:
    """Return what a file is by its first bytes; empty if that is none of the usual mistakes."""
    with path.open("rb") as file:
        start = file.read(100)
    return next((name for first, name in BEGINNINGS.items() if start.startswith(first)), "")
