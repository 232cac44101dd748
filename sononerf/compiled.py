# SPDX-License-Identifier: MIT
"""Loops over rays and echoes as machine code, compiled when first called and then kept on disk."""

from __future__ import annotations

from collections.abc import Callable
from typing import ParamSpec, TypeVar

import numba

Given = ParamSpec("Given")
Result = TypeVar("Result")


def compiled(function: Callable[Given, Result]) -> Callable[Given, Result]:
    """Compile a function of numbers and arrays; other threads run meanwhile.

    Dividing by zero gives infinity or NaN without a warning. Of compiled functions it may call
    those of its own file alone: what is kept on disk is made anew when that file changes.
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
    result: Callable[Given, Result] = made
    return result
