# SPDX-License-Identifier: MIT
"""Memory and cores that this process may use."""

from __future__ import annotations

import os
import shutil
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from sononerf.errors import ResourceError


def available_cores() -> int:
    """Return the number of cores that this process may use."""
    if hasattr(os, "sched_getaffinity"):
        return len(os.sched_getaffinity(0))
    return os.cpu_count() or 1


def available_memory() -> int | None:
    """Return the memory that can still be taken, in bytes; None where the system does not say."""
    free: list[int] = []
    meminfo = Path("/proc/meminfo")
    if meminfo.is_file():
        for line in meminfo.read_text(encoding="ascii").splitlines():
            if line.startswith("MemAvailable:"):
                free.append(int(line.split()[1]) * 1024)
    else:
        try:
            free.append(os.sysconf("SC_PHYS_PAGES") * os.sysconf("SC_PAGE_SIZE"))
        except (AttributeError, ValueError, OSError):
            return None
    # A container may be held to less than the machine has.
    limit, used = Path("/sys/fs/cgroup/memory.max"), Path("/sys/fs/cgroup/memory.current")
    if limit.is_file() and used.is_file():
        bound = limit.read_text(encoding="ascii").strip()
        if bound != "max":
            free.append(int(bound) - int(used.read_text(encoding="ascii")))
    return max(0, min(free)) if free else None


def require_memory(needed: float, what: str, remedy: str) -> None:
    """Refuse work that needs more memory than is free, before it begins."""
    free = available_memory()
    if free is not None and needed > free:
        raise ResourceError(
            f"{what} needs about {gigabytes(needed)} of memory, and {gigabytes(free)} are free; "
            f"{remedy}"
        )


def require_disk(needed: float, folder: Path, what: str, remedy: str) -> None:
    """Refuse files that need more space than the disk has free, before they are written."""
    there = next(place for place in (folder, *folder.absolute().parents) if place.exists())
    free = shutil.disk_usage(there).free
    if needed > free:
        raise ResourceError(
            f"{what} needs about {gigabytes(needed)} of disk, and {gigabytes(free)} are free at "
            f"{there}; {remedy}"
        )


def gigabytes(count: float) -> str:
    """Return a number of bytes as text."""
    return f"{count / 1e9:.2g} GB" if count < 10e9 else f"{count / 1e9:,.0f} GB"


@contextmanager
def memory_faults() -> Iterator[None]:
    """Turn the errors that NumPy and torch raise where memory is short into one of ours."""
    free = available_memory()
    try:
        yield
    except (MemoryError, RuntimeError) as error:
        said = str(error)
        full = ("allocate memory", "not enough memory", "out of memory")  # torch has no own class
        if not isinstance(error, MemoryError) and not any(word in said for word in full):
            raise
        amount = f", of which {gigabytes(free)} were free at the start" if free is not None else ""
        raise ResourceError(
            f"this needs more memory than there is{amount}; use smaller batches (fit.batch_poses), "
            "a smaller region, a coarser field or spectrogram, fewer poses at once, or a larger "
            "machine"
        ) from error
