# SPDX-License-Identifier: MIT
"""How much memory, and how many cores, this process may use."""

from __future__ import annotations

import os
from pathlib import Path


def available_cores() -> int:
    """Return on how many cores this process may run, as far as the system tells."""
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
