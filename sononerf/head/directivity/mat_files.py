# SPDX-License-Identifier: MIT
"""Directivities from the `.mat` files of two bat laboratories' programs, old (v5) or new (v7.3).

============  =================================================================================
struct        fields
============  =================================================================================
array_struct  SonoNERF: ``freq_vec``, ``az_grid_vec``, ``el_grid_vec`` (degrees), and in
              ``left_struct`` and ``right_struct`` each ``hrtf_gridded_array`` (el, az, freq)
bat_hrtf      BatSLAM2: ``freq_vec``, ``az_vec``, ``el_vec`` (degrees), ``hrtf_left``,
              ``hrtf_right`` and perhaps ``hrtf_em``, the emission (az, el, freq)
============  =================================================================================

Only numbers are read. Objects of classes, function handles and the like are refused.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import h5py
import numpy as np
from numpy.typing import NDArray

from sononerf.array_types import Floats
from sononerf.errors import InputError
from sononerf.head.directivity.record import Directivity, unit_vectors

STRUCTS = ("array_struct", "bat_hrtf")
NUMERIC_CLASSES = {
    b"", b"double", b"single", b"logical",
    *(f"{sign}int{bits}".encode() for sign in ("", "u") for bits in (8, 16, 32, 64)),
}  # fmt: skip

Field = Callable[[str], NDArray[Any] | None]
"""Takes a dotted name inside the file; returns the array as MATLAB stored it, or None."""


def read_mat(path: Path) -> Directivity:
    """Read a `.mat` file of version 5 or 7.3."""
    with path.open("rb") as file:
        is_new = b"MATLAB 7.3" in file.read(116)
    return _read_new(path) if is_new else _read_old(path)


def _read_new(path: Path) -> Directivity:
    with opened(path) as file:

        def field(name: str) -> NDArray[Any] | None:
            node: Any = file
            for part in name.split("."):
                if not isinstance(node, h5py.Group):
                    raise InputError(f"{path}: {name} lies in no struct")
                node = find(node, part)
                if node is None:
                    return None
            kind = np.bytes_(node.attrs.get("MATLAB_class", b""))
            if "MATLAB_object_decode" in node.attrs or bytes(kind) not in NUMERIC_CLASSES:
                raise _no_numbers(path, name, bytes(kind).decode("utf-8", "replace"))
            # MATLAB lays out columns first.
            return numbers(node.parent, name.rpartition(".")[2]).T

        return _layout(path, field, [name for name in STRUCTS if find(file, name) is not None])


def _read_old(path: Path) -> Directivity:
    from scipy.io import loadmat
    from scipy.io.matlab import MatReadError

    try:
        content = loadmat(path, variable_names=STRUCTS, squeeze_me=True, struct_as_record=False)
    except (MatReadError, NotImplementedError) as error:
        raise InputError(f"{path}: no .mat file of version 5 or 7.3 ({error})") from None
    except Exception as error:  # the error of a damaged file depends on the parser
        raise InputError(
            f"{path}: damaged or truncated ({type(error).__name__}: {error})"
        ) from None

    def field(name: str) -> NDArray[Any] | None:
        node: Any = content
        for part in name.split("."):
            if isinstance(node, dict):
                node = node.get(part)
            elif type(node).__name__ == "mat_struct":
                node = getattr(node, part, None)
            else:
                raise _no_numbers(path, name, type(node).__name__)
            if node is None:
                return None
        values = np.asarray(node)
        if values.dtype.kind not in NUMBERS:
            raise _no_numbers(path, name, type(node).__name__)
        return values

    return _layout(path, field, [name for name in STRUCTS if name in content])


def _no_numbers(path: Path, name: str, found: str) -> InputError:
    return InputError(
        f"{path}: {name} holds {found or 'something unknown'}, expected an array of numbers; save "
        "it as a plain struct"
    )


def _layout(path: Path, field: Field, structs: list[str]) -> Directivity:
    if not structs:
        raise InputError(f"{path}: holds neither the struct {' nor '.join(STRUCTS)}")
    struct = structs[0]
    if struct == "array_struct":
        axes = ("az_grid_vec", "el_grid_vec")
        tables = {side: f"{side}_struct.hrtf_gridded_array" for side in ("left", "right")}
        order = "elevation, azimuth"
    else:
        axes = ("az_vec", "el_vec")
        tables = {side: f"hrtf_{side}" for side in ("left", "right")}
        order = "azimuth, elevation"

    def needed(name: str) -> NDArray[Any]:
        values = field(f"{struct}.{name}")
        if values is None:
            raise InputError(f"{path}: {struct} has no field {name}")
        return values

    frequency, azimuth, elevation = (
        np.asarray(needed(name), dtype=np.float64).reshape(-1) for name in ("freq_vec", *axes)
    )
    sizes = (len(azimuth), len(elevation))
    shape = (*(sizes if order.startswith("azimuth") else sizes[::-1]), len(frequency))

    def gain(name: str, values: NDArray[Any]) -> Floats:
        if [size for size in values.shape if size > 1] != [size for size in shape if size > 1]:
            raise InputError(
                f"{path}: {struct}.{name} has the shape {values.shape}, expected {shape} "
                f"({order}, frequency)"
            )
        table = values.reshape(shape)
        if not order.startswith("azimuth"):
            table = table.transpose(1, 0, 2)
        real = np.abs(table) if np.iscomplexobj(table) else table
        return np.asarray(real, dtype=np.float64).reshape(-1, len(frequency))

    beam = None
    if struct == "bat_hrtf" and (emitted := field(f"{struct}.hrtf_em")) is not None:
        beam = gain("hrtf_em", emitted)
    if not np.isfinite(azimuth).all() or not np.isfinite(elevation).all():
        raise InputError(f"{path}: an azimuth or elevation is NaN or infinite")
    if np.abs(elevation).max(initial=0.0) > 90.0 or np.abs(azimuth).max(initial=0.0) > 360.0:
        raise InputError(f"{path}: an angle is beyond 90 or 360 degrees; expected degrees")
    grid = np.meshgrid(azimuth, elevation, indexing="ij")
    return Directivity(
        source=str(path),
        directions=unit_vectors(*np.radians(grid)).reshape(-1, 3),
        frequency=frequency,
        gains=np.stack([gain(name, needed(name)) for name in tables.values()]),
        beam=beam,
    )


MOST_BYTES = 2_000_000_000
MOST_DECLARED = 2000
"""Largest declared size over the size of the file: compression of measured data saves no more."""
NUMBERS = "biufc"


@contextmanager
def opened(path: Path) -> Iterator[h5py.File]:
    """Open an HDF5 file for reading; an error of the library becomes one line."""
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
    """Return the group or dataset of a name in a group; None if there is none."""
    link = group.get(name, getlink=True)
    if link is None:
        return None
    if not isinstance(link, h5py.HardLink):
        raise InputError(f"{group.file.filename}: {name} is a link to somewhere else; copy it in")
    return group[name]


def numbers(group: h5py.Group, name: str) -> NDArray[Any]:
    """Return a numeric dataset whole, real or complex."""
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
