# SPDX-License-Identifier: MIT
"""Files that a user names are no devices and no pipes."""

from __future__ import annotations

import stat
from pathlib import Path

from sononerf.errors import InputError


def require_regular(path: Path) -> None:
    """Refuse a device, a pipe or a socket, whose reading may never end.

    Raises:
        InputError: If it is one.
        OSError: If it is not there, or may not be looked at.
    """
    mode = path.stat().st_mode
    if stat.S_ISREG(mode) or stat.S_ISDIR(mode):
        return
    kinds = {stat.S_IFIFO: "a pipe", stat.S_IFSOCK: "a socket"}
    kind = kinds.get(stat.S_IFMT(mode), "a device")
    raise InputError(f"{path}: is {kind}, expected a file; save what it gives as a file first")
