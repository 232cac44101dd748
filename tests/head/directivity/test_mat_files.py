# SPDX-License-Identifier: MIT
import numpy as np
import pytest

from sononerf.errors import InputError
from sononerf.head.directivity_files import read_matlab
from tests.head.directivity.patterns import (
    AZIMUTH,
    FREQUENCY,
    batslam_fields,
    gridded,
    pair,
    sononerf_fields,
    write_v5,
    write_v73,
)

VERSIONS = pytest.mark.parametrize("write", [write_v5, write_v73])


@VERSIONS
@pytest.mark.parametrize("fields", [sononerf_fields, batslam_fields])
def test_both_layouts_in_both_versions(tmp_path, write, fields):
    found, wanted = read_matlab(write(tmp_path / "a.mat", fields())), pair()
    np.testing.assert_allclose(found.directions, wanted.directions, atol=1e-12)
    np.testing.assert_array_equal(found.frequency, FREQUENCY)
    np.testing.assert_allclose(found.gains, wanted.gains)
    assert found.places is None
    if fields is batslam_fields:
        np.testing.assert_allclose(found.beam, wanted.beam)
    else:
        assert found.beam is None


@VERSIONS
def test_complex_gains_count_by_their_magnitude(tmp_path, write):
    _, left, *_ = gridded()
    fields = batslam_fields(hrtf_left=left * np.exp(1j * left))
    if write is write_v73:
        complex_kind = np.dtype([("real", "<f8"), ("imag", "<f8")])
        values = np.zeros(left.shape, dtype=complex_kind)
        values["real"], values["imag"] = left * np.cos(left), left * np.sin(left)
        fields = batslam_fields(hrtf_left=values)
    found = read_matlab(write(tmp_path / "a.mat", fields))
    np.testing.assert_allclose(found.gains, pair().gains)


@VERSIONS
def test_one_frequency_and_no_emission(tmp_path, write):
    _, left, right, _ = gridded()
    fields = batslam_fields(freq_vec=5e4, hrtf_left=left[..., 1:2], hrtf_right=right[..., 1:2])
    del fields["bat_hrtf"]["hrtf_em"]
    found = read_matlab(write(tmp_path / "a.mat", fields))
    np.testing.assert_allclose(found.gains[..., 0], pair().gains[..., 1])
    assert found.beam is None


@VERSIONS
@pytest.mark.parametrize(
    ("fields", "said"),
    [
        ({"other": {"x": 1.0}}, "holds neither the struct array_struct nor bat_hrtf"),
        (batslam_fields(az_vec=AZIMUTH[:-1]), r"hrtf_left has the shape \(19, 17, 3\), expected"),
        (batslam_fields(hrtf_left=gridded()[1] - 1), "the gains hold the negative value"),
        (batslam_fields(hrtf_left=gridded()[1] * np.nan), "the gains hold NaN"),
        (batslam_fields(az_vec=AZIMUTH * 60), "beyond 90 or 360 degrees"),
        (batslam_fields(el_vec=np.full(17, np.nan)), "is NaN or infinite"),
        ({"bat_hrtf": {"freq_vec": FREQUENCY}}, "az_vec is missing, or no array of numbers"),
        (sononerf_fields(left_struct=np.ones(3)), "left_struct"),
    ],
)
def test_a_bad_file_is_one_line(tmp_path, write, fields, said):
    path = write(tmp_path / "a.mat", fields)
    with pytest.raises(InputError, match=said) as raised:
        read_matlab(path)
    assert str(raised.value).startswith(f"{path}: ")
    assert "\n" not in str(raised.value)
