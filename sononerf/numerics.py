# SPDX-License-Identifier: MIT
"""Array types, and numerical loops that are compiled."""

from __future__ import annotations

import os
import stat
import tempfile
from collections.abc import Callable
from pathlib import Path
from typing import ParamSpec, TypeAlias, TypeVar

import numba
import numpy as np
from numpy.typing import NDArray

Floats: TypeAlias = NDArray[np.float64]
Singles: TypeAlias = NDArray[np.float32]
Ints: TypeAlias = NDArray[np.int64]
Bools: TypeAlias = NDArray[np.bool_]
Complexes: TypeAlias = NDArray[np.complex128]


def _keep_machine_code_apart() -> None:
    """Keep it in the folder for temporary files where there is no home: numba takes ``./~``."""
    home = os.path.expanduser("~")  # noqa: PTH111  # pathlib raises where there is none
    if home != "~" or numba.config.CACHE_DIR:
        return
    folder = Path(tempfile.gettempdir()) / f"numba-{os.geteuid()}"
    try:
        folder.mkdir(mode=0o700, exist_ok=True)
        status = folder.lstat()
    except OSError:  # it cannot be made: the code is compiled in each process
        return
    if status.st_uid == os.geteuid() and stat.S_IMODE(status.st_mode) == 0o700:  # nobody else's
        numba.config.CACHE_DIR = str(folder)


_keep_machine_code_apart()
Given = ParamSpec("Given")
Result = TypeVar("Result")


def compiled(function: Callable[Given, Result]) -> Callable[Given, Result]:
    """Compile a function of numbers and arrays. While it runs, other threads can run too.

    Division by zero gives infinity or NaN without a warning. The order of sums is the compiler's,
    so results may differ from NumPy's by rounding. A compiled function may call compiled functions
    of its own file only: numba compiles it anew when that file changes, and looks at no other.
    """
    options = {
        "nogil": True,
        "error_model": "numpy",
        "fastmath": {"contract", "arcp", "nsz", "reassoc"},
    }
    try:
        made = numba.njit(cache=True, **options)(function)
    except RuntimeError:  # no folder may be written: it is compiled in each process
        made = numba.njit(**options)(function)
    return made
