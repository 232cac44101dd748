# SPDX-License-Identifier: MIT
"""HDF5 files from strangers: numbers of plain datasets, nothing that points out of the file."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import h5py
import numpy as np
from numpy.typing import NDArray

from sononerf.errors import InputError

MOST_TIMES = 2000
"""A dataset may be so many times as large as its file: recordings do not pack better."""


@contextmanager
def opened(path: Path) -> Iterator[h5py.File]:
    """Open an HDF5 file for reading.

    Raises
    ------
    InputError
        If it is missing, truncated, or no HDF5 file; also for what is found on reading it.
    """
    if not path.is_file():
        raise InputError(f"{path}: no such file")
    try:
        with h5py.File(path, "r") as file:
            yield file
    except (OSError, RuntimeError, KeyError, ValueError, TypeError) as error:
        said = " ".join(str(error).split())
        raise InputError(f"{path}: damaged, truncated, or no HDF5 file ({said})") from None


def child(group: Any, name: str) -> Any:
    """Return a group's member; None where there is none.

    Raises
    ------
    InputError
        If it is a link.
    """
    link = group.get(name, getlink=True)
    if link is None:
        return None
    if not isinstance(link, h5py.HardLink):
        raise InputError(f"{group.file.filename}: {name} is a link; copy the data into the file")
    return group[name]


def dataset(group: Any, name: str) -> Any:
    """Return a dataset of numbers of its own file, not read; None where there is none.

    Raises
    ------
    InputError
        If it is no dataset of numbers, lies in another file, or is larger than it can be.
    """
    node = group
    for part in name.strip("/").split("/"):
        if not isinstance(node, h5py.Group):
            return None
        node = child(node, part)
    if node is None:
        return None
    path = group.file.filename
    if not isinstance(node, h5py.Dataset) or node.dtype.kind not in "biuf":
        raise InputError(f"{path}: {name} is no array of numbers")
    if node.is_virtual or node.external:
        raise InputError(f"{path}: {name} lies in another file; copy the data into this one")
    if node.nbytes > MOST_TIMES * max(Path(path).stat().st_size, 1):
        raise InputError(f"{path}: {name} declares {node.nbytes} bytes, more than the file holds")
    return node


def numbers(group: Any, name: str) -> NDArray[Any] | None:
    """Return a dataset's numbers; see :func:`dataset`."""
    found = dataset(group, name)
    return None if found is None else np.asarray(found[()])
