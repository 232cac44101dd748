# SPDX-License-Identifier: MIT
"""Of HDF5 files nothing is read but plain numbers of the file itself."""

from __future__ import annotations

import h5py
import numpy as np
import pytest

from sononerf.errors import InputError
from sononerf.matlab_files import numbers, opened


def read(path, name):
    with opened(path) as file:
        return numbers(file, name)


def test_numbers_are_read_by_name(tmp_path):
    with h5py.File(tmp_path / "a.h5", "w") as file:
        file["na/position"] = np.arange(3.0)
    assert read(tmp_path / "a.h5", "/na/position").tolist() == [0, 1, 2]
    assert read(tmp_path / "a.h5", "na/none") is None
    assert read(tmp_path / "a.h5", "none/at/all") is None


def test_what_points_elsewhere_or_is_no_number_is_refused(tmp_path):
    path = tmp_path / "a.h5"
    with h5py.File(tmp_path / "b.h5", "w") as file:
        file["x"] = np.arange(3.0)
    with h5py.File(path, "w") as file:
        file["soft"] = h5py.SoftLink("/x")
        file["far"] = h5py.ExternalLink("b.h5", "x")
        file["text"] = "words"
        layout = h5py.VirtualLayout(shape=(3,), dtype="f8")
        layout[:] = h5py.VirtualSource(tmp_path / "b.h5", "x", shape=(3,))
        file.create_virtual_dataset("virtual", layout)
        file.create_dataset("huge", shape=(10**10,), dtype="f8", chunks=(1000,))
        file.create_group("group")
    for name, words in (
        ("soft", "is a link"),
        ("far", "is a link"),
        ("text", "no array of numbers"),
        ("group", "no array of numbers"),
        ("virtual", "lies in another file"),
        ("huge", "more than the file holds"),
    ):
        with pytest.raises(InputError, match=words):
            read(path, name)


def test_broken_files_are_told_in_one_line(tmp_path):
    whole = tmp_path / "whole.h5"
    with h5py.File(whole, "w") as file:
        file["x"] = np.arange(10_000.0)
    (tmp_path / "short.h5").write_bytes(whole.read_bytes()[:4000])
    (tmp_path / "text.h5").write_text("x,y\n")
    for name, words in (("short.h5", "truncated"), ("text.h5", "no HDF5"), ("none.h5", "no such")):
        with pytest.raises(InputError, match=words) as caught:
            read(tmp_path / name, "x")
        assert "\n" not in str(caught.value)
