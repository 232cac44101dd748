# SPDX-License-Identifier: MIT
"""HDF5 files, and MATLAB files of version 5 (SciPy) and 7.3 (HDF5), as plain data."""

from __future__ import annotations

import errno
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import h5py
import numpy as np
import scipy.io
from numpy.typing import NDArray

from sononerf.errors import InputError
from sononerf.numerics import Floats
from sononerf.storage import wrong_kind

NUMERIC = {"double", "single", "logical", "char"} | {
    f"{sign}int{bits}" for sign in ("", "u") for bits in (8, 16, 32, 64)
}
MOST_DEPTH = 12
PLAIN = "save it again with numbers, structs and cells alone"


def read_mat(path: Path, names: tuple[str, ...]) -> dict[str, Any]:
    """Read variables of a MATLAB file."""
    if not path.is_file():
        raise InputError(f"{path}: no such file")
    with path.open("rb") as file:
        start = file.read(128)
    if start.startswith(b"MATLAB 7.3 MAT-file"):
        with opened(path) as group:
            return {
                name: _new(path, group, child(group, name), name, 0)
                for name in names
                if name in group
            }
    if not start.startswith(b"MATLAB 5.0 MAT-file"):
        raise wrong_kind(path, "MATLAB file of version 5 or 7.3")
    try:
        content = scipy.io.loadmat(path, variable_names=list(names), struct_as_record=True)
    except (NotImplementedError, MemoryError) as error:
        raise InputError(f"{path}: cannot be read ({error})") from None
    except Exception as error:  # the error of a damaged file depends on the parser
        said = " ".join(str(error).split())
        raise InputError(f"{path}: damaged or truncated MATLAB file ({said})") from None
    return {name: _old(path, content[name], name, 0) for name in names if name in content}


def _refused(path: Path, name: str, kind: str) -> InputError:
    return InputError(f"{path}: {name} holds an object ({kind}); {PLAIN}")


def _old(path: Path, value: Any, name: str, depth: int) -> Any:
    matlab = scipy.io.matlab
    if depth > MOST_DEPTH:
        raise InputError(f"{path}: {name} is nested too deeply")
    if isinstance(value, matlab.MatlabOpaque | matlab.MatlabFunction | matlab.MatlabObject):
        raise _refused(path, name, getattr(value, "classname", None) or type(value).__name__)
    if not isinstance(value, np.ndarray):
        raise _refused(path, name, type(value).__name__)
    if value.dtype.names is not None:
        structs = [
            {key: _old(path, one[key], f"{name}.{key}", depth + 1) for key in value.dtype.names}
            for one in value.reshape(-1, order="F")
        ]
        return structs[0] if value.size == 1 else structs
    if value.dtype.kind == "O":
        return [_old(path, one, name, depth + 1) for one in value.reshape(-1, order="F")]
    if value.dtype.kind == "U":
        return "".join(value.reshape(-1))
    if value.dtype.kind not in "biufc":
        raise _refused(path, name, str(value.dtype))
    return value


def _new(path: Path, file: Any, node: Any, name: str, depth: int) -> Any:
    if depth > MOST_DEPTH:
        raise InputError(f"{path}: {name} is nested too deeply")
    kind = node.attrs.get("MATLAB_class", b"")
    kind = kind.decode("utf-8", "replace") if isinstance(kind, bytes) else str(kind)
    if "MATLAB_object_decode" in node.attrs:
        raise _refused(path, name, kind or "unknown class")
    if isinstance(node, h5py.Group):
        if kind not in ("struct", ""):
            raise _refused(path, name, kind)
        return _struct(path, file, node, name, depth)
    if kind not in {*NUMERIC, "cell", "struct", ""}:
        raise _refused(path, name, kind)
    if "MATLAB_empty" in node.attrs:
        return [] if kind == "cell" else np.zeros((0, 0))
    if node.dtype.kind == "O":
        return [
            _new(path, file, _target(path, file, one, name), name, depth + 1)
            for one in node[()].T.reshape(-1, order="F")
        ]
    values = np.asarray(numbers(node.parent, node.name.rpartition("/")[2])).T
    if kind == "char":
        return "".join(chr(int(letter)) for letter in values.reshape(-1, order="F"))
    return values


def _target(path: Path, file: Any, reference: Any, name: str) -> Any:
    if not isinstance(reference, h5py.Reference) or not reference:
        raise InputError(f"{path}: {name} points to nothing; the file is damaged")
    return file[reference]


def _struct(path: Path, file: Any, node: Any, name: str, depth: int) -> Any:
    """Return a struct; an array of structs has references in each of its fields."""
    fields = {key: child(node, key) for key in node}
    many = [
        one
        for one in fields.values()
        if isinstance(one, h5py.Dataset)
        and one.dtype.kind == "O"
        and "MATLAB_class" not in one.attrs
    ]
    values = {key: _new(path, file, one, f"{name}.{key}", depth + 1) for key, one in fields.items()}
    if many and len(many) == len(fields):
        count = many[0].size
        return [{key: values[key][i] for key in values} for i in range(count)]
    return values


def as_list(value: Any) -> list[Any]:
    """Return the elements of a cell or of an array of structs; one struct is a list of one."""
    return value if isinstance(value, list) else [value]


def vector(path: Path, where: dict[str, Any], name: str, size: int) -> Floats:
    """Return a field of some numbers, (size,)."""
    found = where.get(name) if isinstance(where, dict) else None
    values = np.asarray(found if isinstance(found, np.ndarray) else [], dtype=np.float64)
    values = values.reshape(-1)
    if len(values) != size or not np.isfinite(values).all():
        raise InputError(f"{path}: {name} has {len(values)} values, expected {size} numbers")
    return values


MOST_TIMES = 2000
"""Largest size of a dataset over that of its file: recordings do not compress better."""


@contextmanager
def opened(path: Path) -> Iterator[h5py.File]:
    """Open an HDF5 file for reading."""
    if not path.is_file():
        raise InputError(f"{path}: no such file")
    try:
        with _readable(path) as file:
            yield file
    except (OSError, RuntimeError, KeyError, ValueError, TypeError) as error:
        if not h5py.is_hdf5(path):
            raise wrong_kind(path, "HDF5 file") from None
        said = " ".join(str(error).split())
        raise InputError(f"{path}: damaged, truncated, or no HDF5 file ({said})") from None


NO_LOCKS = (errno.ENOLCK, errno.ENOSYS, errno.EOPNOTSUPP)
"""What the system says of a disk that knows no locks."""


def _readable(path: Path) -> h5py.File:
    try:
        return h5py.File(path, "r")
    except BlockingIOError:
        raise InputError(
            f"{path}: another process has it open for writing; close it there, or copy the file"
        ) from None
    except OSError as error:
        if error.errno not in NO_LOCKS:
            raise
        return h5py.File(path, "r", locking=False)


def child(group: Any, name: str) -> Any:
    """Return a group's member; None if there is none."""
    link = group.get(name, getlink=True)
    if link is None:
        return None
    if not isinstance(link, h5py.HardLink):
        raise InputError(f"{group.file.filename}: {name} is a link; copy the data into the file")
    return group[name]


def numbers(group: Any, name: str) -> NDArray[Any] | None:
    """Return a dataset of numbers of its own file, real or complex; None if there is none."""
    node = group
    for part in name.strip("/").split("/"):
        if not isinstance(node, h5py.Group):
            return None
        node = child(node, part)
    if node is None:
        return None
    path = group.file.filename
    is_complex = isinstance(node, h5py.Dataset) and node.dtype.names == ("real", "imag")
    if not isinstance(node, h5py.Dataset) or (node.dtype.kind not in "biufc" and not is_complex):
        raise InputError(f"{path}: {name} is no array of numbers")
    if node.is_virtual or node.external:
        raise InputError(f"{path}: {name} lies in another file; copy the data into this one")
    if node.nbytes > MOST_TIMES * max(Path(path).stat().st_size, 1):
        raise InputError(f"{path}: {name} declares {node.nbytes} bytes, more than the file holds")
    values = np.asarray(node[()])
    return values["real"] + 1j * values["imag"] if is_complex else values
