# SPDX-License-Identifier: MIT
"""HDF5 files from strangers: checked before anything is read of them.

An HDF5 file may point to other files and may declare more data than it holds. Such files are
refused. Names are followed one by one, and only plain numbers and text are read.
"""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import h5py
import numpy as np
from numpy.typing import NDArray

from sononerf.errors import InputError

MOST_BYTES = 2_000_000_000
MOST_DECLARED = 2000
"""A file may declare so many times its own size: compression saves no more on measured data."""
NUMBERS = "biufc"


@contextmanager
def opened(path: Path) -> Iterator[h5py.File]:
    """Open an HDF5 file for reading; what the library says of a damaged one becomes one line.

    Raises
    ------
    InputError
        If it is missing, too large, damaged, or no HDF5 file.
    """
    try:
        if path.stat().st_size > MOST_BYTES:
            raise InputError(f"{path}: larger than {MOST_BYTES} bytes")
        with h5py.File(path, "r") as file:
            yield file
    except FileNotFoundError:
        raise InputError(f"{path}: no such file") from None
    except (OSError, RuntimeError, KeyError, ValueError, TypeError) as error:
        said = " ".join(str(error).split())
        raise InputError(f"{path}: damaged or truncated, or no HDF5 file ({said})") from None


def find(group: h5py.Group, name: str) -> Any:
    """Return the group or dataset of a name in a group; None where there is none.

    Raises
    ------
    InputError
        If it is a link to somewhere else.
    """
    link = group.get(name, getlink=True)
    if link is None:
        return None
    if not isinstance(link, h5py.HardLink):
        raise InputError(f"{group.file.filename}: {name} is a link to somewhere else; copy it in")
    return group[name]


def numbers(group: h5py.Group, name: str) -> NDArray[Any]:
    """Return a numeric dataset whole, real or complex.

    Raises
    ------
    InputError
        If it is missing, is no array of numbers, or lies outside the file.
    """
    path = group.file.filename
    array = find(group, name)
    if not isinstance(array, h5py.Dataset):
        raise InputError(f"{path}: holds no {name}")
    kind = array.dtype
    parts = kind.fields or {}
    is_complex = set(parts) == {"real", "imag"} and all(
        part[0].kind in NUMBERS for part in parts.values()
    )
    if kind.kind not in NUMBERS and not is_complex:
        raise InputError(f"{path}: {name} holds {kind}, expected numbers")
    if array.is_virtual or array.external:
        raise InputError(f"{path}: {name} lies in another file; copy it in")
    if array.nbytes > min(MOST_BYTES, MOST_DECLARED * Path(path).stat().st_size):
        raise InputError(f"{path}: {name} declares {array.nbytes} bytes, more than the file holds")
    values = np.asarray(array[()])
    if is_complex:
        return np.asarray(values["real"] + 1j * values["imag"])
    return values


def text(owner: Any, name: str, otherwise: str = "") -> str:
    """Return a text attribute of a group or dataset, or ``otherwise`` where it is not there."""
    value = owner.attrs.get(name, otherwise)
    if isinstance(value, np.ndarray):
        value = value.reshape(-1)[0] if value.size else otherwise
    if isinstance(value, bytes):
        return value.decode("utf-8", "replace")
    return str(value)
