# SPDX-License-Identifier: MIT
"""Array types, and numerical loops that are compiled."""

from __future__ import annotations

from collections.abc import Callable
from typing import ParamSpec, TypeAlias, TypeVar

import numba
import numpy as np
from numpy.typing import NDArray

Floats: TypeAlias = NDArray[np.float64]
Singles: TypeAlias = NDArray[np.float32]
Ints: TypeAlias = NDArray[np.int64]
Bools: TypeAlias = NDArray[np.bool_]
Complexes: TypeAlias = NDArray[np.complex128]


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
