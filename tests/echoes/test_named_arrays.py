# SPDX-License-Identifier: MIT
"""Arrays come back from files of other programs with names, axes and units."""

from __future__ import annotations

import io

import h5py
import numpy as np
import pytest
import scipy.io

from sononerf.echoes import named_arrays
from sononerf.echoes.named_arrays import Named, file_bytes
from sononerf.errors import ResourceError

ARRAYS = {
    "level": Named(np.arange(6, dtype=np.float32).reshape(2, 3), ("pose", "range"), "dB", "level"),
    "range": Named(np.array([0.1, 0.2, 0.3]), ("range",), "m", "one-way distance"),
    "number": Named(np.array([7, 8], dtype=np.int64), ("pose",), "", "of the pose"),
}


def test_matlab():
    found = scipy.io.loadmat(io.BytesIO(file_bytes("mat", ARRAYS, {"origin": "simulated"})))
    assert np.array_equal(found["level"], ARRAYS["level"].values)
    assert found["range"].shape == (3, 1)
    assert found["units"]["level"][0, 0][0] == "dB"
    assert found["axes"]["level"][0, 0][0] == "pose, range"
    assert found["attributes"]["origin"][0, 0][0] == "simulated"


def test_hdf5():
    with h5py.File(io.BytesIO(file_bytes("h5", ARRAYS, {"origin": "simulated"}))) as file:
        assert np.array_equal(file["number"][...], [7, 8])
        assert file["level"].attrs["units"] == "dB"
        assert [axis.label for axis in file["level"].dims] == ["pose", "range"]
        assert np.array_equal(file["level"].dims[1][0][...], ARRAYS["range"].values)
        assert file.attrs["origin"] == "simulated"


def test_netcdf():
    data = file_bytes("nc", ARRAYS, {"origin": "simulated"})
    with scipy.io.netcdf_file(io.BytesIO(data), mmap=False) as file:
        assert file.variables["level"].dimensions == ("pose", "range")
        assert np.array_equal(file.variables["level"][...], ARRAYS["level"].values)
        assert file.variables["level"].units == b"dB"
        assert file.variables["number"][...].tolist() == [7, 8]
        assert file.origin == b"simulated"


@pytest.mark.parametrize("kind", ["mat", "h5", "nc"])
def test_the_same_arrays_give_the_same_bytes(kind, monkeypatch):
    first = file_bytes(kind, ARRAYS, {})
    monkeypatch.setattr("time.asctime", lambda *given: "another day")
    assert file_bytes(kind, ARRAYS, {}) == first


@pytest.mark.parametrize("kind", ["mat", "nc"])
def test_what_is_too_large_for_a_format_is_refused(kind, monkeypatch):
    monkeypatch.setitem(named_arrays.LARGEST, kind, 20)
    with pytest.raises(ResourceError, match=r"level: .* choose a \.h5 file"):
        file_bytes(kind, ARRAYS, {})
