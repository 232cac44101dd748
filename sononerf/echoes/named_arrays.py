# SPDX-License-Identifier: MIT
"""Arrays with names, axes and units, as files of MATLAB, HDF5 and NetCDF."""

from __future__ import annotations

import io
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, Literal

import h5py
import numpy as np
import scipy.io
from numpy.typing import NDArray

from sononerf.errors import ResourceError

FileType = Literal["mat", "h5", "nc"]

LARGEST = {"mat": 2**31 - 1, "nc": 2**31 - 4}
"""Bytes that one array may have in MATLAB's format of version 5 and in NetCDF's of version 3."""
HEAD = "MATLAB 5.0 MAT-file, written by sononerf"
"""In place of the usual header, which holds the date: the same arrays give the same bytes."""


@dataclass(frozen=True, eq=False)
class Named:
    """An array that says what it is.

    Attributes:
        values: Any shape.
        axes: Name of each dimension. A one-dimensional array of the same name holds its
            coordinates.
        units: Such as ``m``; empty for a plain number.
        meaning: A few words.
    """

    values: NDArray[Any]
    axes: tuple[str, ...]
    units: str
    meaning: str


def file_bytes(
    file_type: FileType, arrays: Mapping[str, Named], attributes: Mapping[str, str]
) -> bytes:
    """Return arrays as the bytes of a file; the same arrays give the same bytes.

    MATLAB's file (version 5) has one variable per array and the structs ``units``, ``axes`` and
    ``attributes``. HDF5 has one dataset per array, with dimension scales. NetCDF (version 3, 64-bit
    offsets) has one variable per array; :func:`xarray.open_dataset` reads it.

    Args:
        file_type: Kind of file.
        arrays: By their names in the file.
        attributes: Of the whole file.

    Raises:
        ResourceError: If an array is too large for the kind of file.
    """
    most = LARGEST.get(file_type)
    for name, array in arrays.items():
        if most is not None and array.values.nbytes > most:
            raise ResourceError(
                f"{name}: {array.values.nbytes / 1e9:.1f} GB, and a .{file_type} file holds "
                f"at most {most / 1e9:.1f} GB in one array; choose a .h5 file"
            )
    writers = {"mat": _matlab, "h5": _hdf5, "nc": _netcdf}
    return writers[file_type](arrays, attributes)


def _matlab(arrays: Mapping[str, Named], attributes: Mapping[str, str]) -> bytes:
    data: dict[str, Any] = {name: array.values for name, array in arrays.items()}
    data["units"] = {name: array.units for name, array in arrays.items()}
    data["axes"] = {name: ", ".join(array.axes) for name, array in arrays.items()}
    data["attributes"] = dict(attributes)
    file = io.BytesIO()
    scipy.io.savemat(file, data, do_compression=True, oned_as="column", long_field_names=True)
    return HEAD.ljust(116).encode() + file.getvalue()[116:]


def _hdf5(arrays: Mapping[str, Named], attributes: Mapping[str, str]) -> bytes:
    buffer = io.BytesIO()
    with h5py.File(buffer, "w") as file:
        for key, text in attributes.items():
            file.attrs[key] = text
        for name, array in arrays.items():
            made = file.create_dataset(name, data=array.values, track_times=False)
            made.attrs["units"], made.attrs["long_name"] = array.units, array.meaning
            if array.axes == (name,):
                made.make_scale(name)
        for name, array in arrays.items():
            for number, axis in enumerate(array.axes):
                file[name].dims[number].label = axis
                if axis in arrays and axis != name:
                    file[name].dims[number].attach_scale(file[axis])
    return buffer.getvalue()


def _netcdf(arrays: Mapping[str, Named], attributes: Mapping[str, str]) -> bytes:
    buffer = io.BytesIO()
    with scipy.io.netcdf_file(buffer, "w", version=2) as file:
        for key, text in attributes.items():
            setattr(file, key, text)
        for array in arrays.values():
            for axis, size in zip(array.axes, array.values.shape, strict=True):
                if axis not in file.dimensions:
                    file.createDimension(axis, size)
        for name, array in arrays.items():
            values = array.values
            if values.dtype.kind in "iub" and values.dtype.itemsize > 1:
                values = values.astype(np.int32)  # the format has no longer integers
            made = file.createVariable(name, values.dtype, array.axes)
            made[...] = values
            if array.units:
                made.units = array.units
            made.long_name = array.meaning
        file.flush()
        return buffer.getvalue()
