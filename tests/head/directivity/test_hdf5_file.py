# SPDX-License-Identifier: MIT
import h5py
import numpy as np
import pytest

from sononerf.errors import InputError
from sononerf.head.directivity.mat_files import numbers, opened, text


def fill(path, make):
    with h5py.File(path, "w") as file:
        make(file)
    return path


def external(file):
    other = file.filename + ".bin"
    np.ones(4).tofile(other)
    file.create_dataset("a", (4,), "f8", external=[(other, 0, 32)])


def virtual(file):
    source = h5py.VirtualSource(file.filename + ".other", "a", shape=(4,))
    layout = h5py.VirtualLayout((4,), "f8")
    layout[:] = source
    file.create_virtual_dataset("a", layout)


@pytest.mark.parametrize(
    ("make", "said"),
    [
        (lambda file: None, "holds no a"),
        (lambda file: file.create_group("a"), "holds no a"),
        (lambda file: file.__setitem__("a", h5py.ExternalLink("/etc/hostname", "b")), "is a link"),
        (lambda file: file.__setitem__("a", h5py.SoftLink("/b")), "is a link"),
        (external, "lies in another file"),
        (virtual, "lies in another file"),
        (lambda file: file.create_dataset("a", (10**10,), "f8", chunks=True), "declares"),
        (lambda file: file.create_dataset("a", data=["x"], dtype=h5py.string_dtype()), "numbers"),
    ],
)
def test_what_points_elsewhere_or_is_no_number_is_refused(tmp_path, make, said):
    path = fill(tmp_path / "a.h5", make)
    with pytest.raises(InputError, match=said) as raised, opened(path) as file:
        numbers(file, "a")
    assert str(raised.value).startswith(f"{path}: ")


def test_numbers_and_text(tmp_path):
    def make(file):
        file["a"] = np.arange(3)
        file["a"].attrs["unit"] = np.bytes_("metre")
        file["a"].attrs["name"] = ["b"]

    with opened(fill(tmp_path / "a.h5", make)) as file:
        np.testing.assert_array_equal(numbers(file, "a"), [0, 1, 2])
        assert text(file["a"], "unit") == "metre"
        assert text(file["a"], "name") == "b"
        assert text(file["a"], "missing", "none") == "none"


def test_what_is_no_hdf5_or_not_there(tmp_path):
    path = tmp_path / "a.h5"
    with pytest.raises(InputError, match="no such file"), opened(path):
        pass
    path.write_bytes(b"\x89HDF\r\n\x1a\n" + bytes(100))
    with pytest.raises(InputError, match="damaged or truncated"), opened(path):
        pass
