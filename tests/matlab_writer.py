# SPDX-License-Identifier: MIT
"""Writes MATLAB files of version 7.3 as MATLAB lays them out, for tests of their reader."""

from __future__ import annotations

import h5py
import numpy as np


def write_new(path, variables):
    """Write dicts as structs, lists as cells, str as char and arrays as double."""
    with h5py.File(path, "w", userblock_size=512) as file:
        references = file.create_group("#refs#")
        for name, value in variables.items():
            _put(file, references, file, name, value)
    text = b"MATLAB 7.3 MAT-file, Platform: GLNXA64, Created by a test".ljust(124) + b"\x00\x02IM"
    with path.open("r+b") as file:
        file.write(text)
    return path


def _put(file, references, group, name, value):
    if isinstance(value, dict):
        made = group.create_group(name)
        made.attrs["MATLAB_class"] = np.bytes_("struct")
        for key, inner in value.items():
            _put(file, references, made, key, inner)
    elif isinstance(value, list):
        made = group.create_dataset(name, (len(value), 1), dtype=h5py.ref_dtype)
        made.attrs["MATLAB_class"] = np.bytes_("cell")
        for row, inner in enumerate(value):
            label = f"c{len(references)}"
            _put(file, references, references, label, inner)
            made[row, 0] = references[label].ref
    elif isinstance(value, str):
        letters = np.array([[ord(letter)] for letter in value], dtype="u2")
        made = group.create_dataset(name, data=letters)
        made.attrs["MATLAB_class"] = np.bytes_("char")
    else:
        made = group.create_dataset(name, data=np.atleast_2d(np.asarray(value, float)).T)
        made.attrs["MATLAB_class"] = np.bytes_("double")
