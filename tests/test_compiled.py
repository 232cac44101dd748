# SPDX-License-Identifier: MIT
"""Machine code that is kept on disk: it is made anew when anything it is made from changes."""

import importlib
import os
from pathlib import Path

import pytest

import sononerf

PACKAGE = Path(sononerf.__file__).parent
HOLDERS = sorted(
    str(path.relative_to(PACKAGE.parent).with_suffix("")).replace(os.sep, ".")
    for path in PACKAGE.rglob("*.py")
    if "\n@compiled\n" in path.read_text(encoding="utf-8")
)


def is_compiled(value):
    return hasattr(value, "py_func")


@pytest.mark.parametrize("name", HOLDERS)
def test_a_compiled_function_calls_compiled_ones_of_its_own_file_alone(name):
    """Numba looks at the time of that file, and of no other."""
    module = importlib.import_module(name)
    own = {key: value for key, value in vars(module).items() if is_compiled(value)}
    assert own
    for function in own.values():
        if function.py_func.__module__ != name:
            continue
        for called in function.py_func.__code__.co_names:
            value = own.get(called)
            assert value is None or value.py_func.__module__ == name, called
