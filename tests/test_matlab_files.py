# SPDX-License-Identifier: MIT
"""MATLAB files of both versions give the same; objects and broken files are refused."""

from __future__ import annotations

import h5py
import numpy as np
import pytest
import scipy.io

from sononerf.errors import InputError
from sononerf.matlab_files import as_list, read_mat, vector
from tests.matlab_writer import write_new

INNER = {
    "position": np.array([[1.0, 2.0, 3.0]]),
    "name": "bat",
    "taps": np.arange(6.0).reshape(2, 3),
}


def write_old(path, variables):
    def plain(value):
        if isinstance(value, list):
            cell = np.zeros((1, len(value)), dtype=object)
            for index, one in enumerate(value):
                cell[0, index] = plain(one)
            return cell
        return {k: plain(v) for k, v in value.items()} if isinstance(value, dict) else value

    scipy.io.savemat(path, {name: plain(value) for name, value in variables.items()})
    return path


@pytest.mark.parametrize("write", [write_old, write_new])
def test_cells_of_structs_come_as_lists_of_dicts(tmp_path, write):
    path = write(tmp_path / "a.mat", {"data": [INNER, INNER], "one": INNER, "other": np.eye(2)})
    found = read_mat(path, ("data", "one", "none"))
    assert sorted(found) == ["data", "one"]
    assert len(found["data"]) == 2
    for struct in (*found["data"], found["one"]):
        assert struct["name"] == "bat"
        np.testing.assert_array_equal(struct["taps"], INNER["taps"])
        assert vector(path, struct, "position", 3).tolist() == [1, 2, 3]
    assert as_list(found["one"]) == [found["one"]]


def test_an_array_of_structs_is_a_list(tmp_path):
    many = np.zeros((1, 2), dtype=[("x", object)])
    many["x"][0] = [np.array([[1.0]]), np.array([[2.0]])]
    scipy.io.savemat(tmp_path / "old.mat", {"s": many})
    write_new(tmp_path / "new.mat", {"t": 0.0})
    with h5py.File(tmp_path / "new.mat", "r+") as file:
        struct = file.create_group("s")
        struct.attrs["MATLAB_class"] = np.bytes_("struct")
        field = struct.create_dataset("x", (2, 1), dtype=h5py.ref_dtype)
        for row in range(2):
            one = file["#refs#"].create_dataset(f"e{row}", data=[[row + 1.0]])
            one.attrs["MATLAB_class"] = np.bytes_("double")
            field[row, 0] = one.ref
    for name in ("old.mat", "new.mat"):
        found = read_mat(tmp_path / name, ("s",))["s"]
        assert [float(each["x"][0, 0]) for each in found] == [1.0, 2.0]


def test_empty_arrays_are_empty(tmp_path):
    path = write_new(tmp_path / "a.mat", {"x": 0.0})
    with h5py.File(path, "r+") as file:
        file["x"].attrs["MATLAB_empty"] = np.uint8(1)
    assert read_mat(path, ("x",))["x"].size == 0


def test_a_field_of_another_size_is_told(tmp_path):
    with pytest.raises(InputError, match="position has 0 values, expected 3"):
        vector(tmp_path, {}, "position", 3)
    with pytest.raises(InputError, match="position has 2 values"):
        vector(tmp_path, {"position": np.zeros((1, 2))}, "position", 3)
