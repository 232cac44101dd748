# SPDX-License-Identifier: MIT
"""Files of the in-air synthetic aperture sonar: a track along x, channels by number."""

from __future__ import annotations

import h5py
import numpy as np
import pytest

from sononerf.errors import InputError
from sononerf.recordings.pose_tables import to_poses
from sononerf.recordings.readers import read_airsas
from sononerf.settings.sections import ImportSettings

COUNT, SAMPLES = 5, 80
RATE = ImportSettings(sampling_rate=1e5)


def write(path, **changes):
    rng = np.random.default_rng(0)
    given = {
        "ch10/ts": rng.standard_normal((COUNT, SAMPLES)),
        "ch2/ts": rng.standard_normal((COUNT, SAMPLES)),
        "na/position": np.arange(COUNT) * 0.01,
        "na/temperature": np.full(COUNT, 21.5),
        **changes,
    }
    with h5py.File(path, "w") as file:
        for name, values in given.items():
            if values is not None:
                file[name] = values
    return given


def test_channels_positions_and_temperature(tmp_path):
    given = write(tmp_path / "a.h5")
    found = read_airsas(tmp_path / "a.h5", RATE)
    np.testing.assert_array_equal(found.read(3), [given["ch2/ts"][3], given["ch10/ts"][3]])
    poses = to_poses(found.columns, RATE)
    np.testing.assert_allclose(poses.positions[:, 0], np.arange(COUNT) * 0.01)
    np.testing.assert_allclose(poses.rotations[0] @ [1, 0, 0], [0, 1, 0], atol=1e-12)
    assert found.settings == {"air": {"temperature_c": 21.5}}
    assert (found.sampling_rate, found.notes) == (1e5, ("channels ch2, ch10",))


def test_layout_of_matlab_and_places_of_three(tmp_path):
    series = np.arange(COUNT * SAMPLES, dtype=float).reshape(SAMPLES, COUNT)
    places = np.random.default_rng(0).random((3, COUNT))
    write(tmp_path / "a.h5", **{"ch2/ts": series, "ch10/ts": None, "na/position": places})
    settings = ImportSettings(sampling_rate=1e5, look_at=[0, 0, 0])
    found = read_airsas(tmp_path / "a.h5", settings)
    np.testing.assert_array_equal(found.read(1)[0], series[:, 1])
    np.testing.assert_allclose(to_poses(found.columns, settings).positions, places.T)


@pytest.mark.parametrize(
    ("changes", "words"),
    [
        ({"ch2/ts": None, "ch10/ts": None}, "holds no /ch1/ts"),
        ({"na/position": None}, "holds no /na/position"),
        ({"na/position": np.zeros(4)}, "there are 4 poses in /na/position"),
        ({"na/position": np.full(COUNT, np.nan)}, "not finite"),
        ({"na/position": np.zeros((COUNT, 2))}, "/na/position has shape"),
        ({"ch2/ts": np.zeros((COUNT, 70))}, "channels differ in length"),
    ],
)
def test_another_layout_is_told(tmp_path, changes, words):
    write(tmp_path / "a.h5", **changes)
    with pytest.raises(InputError, match=words):
        read_airsas(tmp_path / "a.h5", RATE)


def test_the_rate_must_be_said(tmp_path):
    write(tmp_path / "a.h5")
    with pytest.raises(InputError, match=r"set import\.sampling_rate"):
        read_airsas(tmp_path / "a.h5", ImportSettings())
