# SPDX-License-Identifier: MIT
"""The format `numpy`: arrays by name, in .npz and HDF5 alike."""

from __future__ import annotations

import h5py
import numpy as np
import pytest

from sononerf.errors import InputError
from sononerf.recordings.pose_tables import to_poses
from sononerf.recordings.readers import read_numpy
from sononerf.settings.import_schema import ImportSettings

COUNT, RECEIVERS, SAMPLES = 4, 2, 50
PLAIN = ImportSettings()


def arrays(**changes):
    rng = np.random.default_rng(0)
    given = {
        "waveform": rng.standard_normal((COUNT, RECEIVERS, SAMPLES)),
        "sampling_rate": 1e5,
        "start": 1.25e-4,
        "position_mm": rng.standard_normal((COUNT, 3)),
        "euler_deg": np.zeros((COUNT, 3)),
        "split": np.array([0, 0, 1, 2]),
        **changes,
    }
    return {name: values for name, values in given.items() if values is not None}


def save(path, given):
    if path.suffix == ".npz":
        np.savez(path, **given)
    else:
        with h5py.File(path, "w") as file:
            for name, values in given.items():
                file[name] = values
    return path


@pytest.mark.parametrize("name", ["a.npz", "a.h5"])
def test_arrays_become_pings_and_poses(tmp_path, name):
    given = arrays()
    found = read_numpy(save(tmp_path / name, given), PLAIN)
    assert (len(found), found.sampling_rate) == (COUNT, 1e5)
    np.testing.assert_array_equal(found.read(2), given["waveform"][2])
    np.testing.assert_allclose(found.emission, -1.25e-4)
    poses = to_poses(found.columns, PLAIN)
    np.testing.assert_allclose(poses.positions, given["position_mm"] / 1000)
    np.testing.assert_allclose(poses.rotations, np.broadcast_to(np.eye(3), (COUNT, 3, 3)))
    assert found.columns.split().tolist() == [0, 0, 1, 2]


def test_one_receiver_needs_no_axis_and_a_turntable_no_orientation(tmp_path):
    angle = np.arange(COUNT) * 90.0
    given = arrays(
        waveform=np.zeros((COUNT, SAMPLES)),
        start=np.arange(COUNT) * 1e-5,
        position_mm=None,
        euler_deg=None,
        angle_deg=angle,
        height_mm=0 * angle,
    )
    settings = ImportSettings(turntable={"radius": 0.6})
    found = read_numpy(save(tmp_path / "a.npz", given), settings)
    assert found.read(0).shape == (1, SAMPLES)
    np.testing.assert_allclose(found.emission, -np.arange(COUNT) * 1e-5)
    away = np.linalg.norm(to_poses(found.columns, settings).positions, axis=1)
    np.testing.assert_allclose(away, 0.6)


@pytest.mark.parametrize("order", ["wxyz", "xyzw"])
def test_the_order_of_quaternions_is_stated(tmp_path, order):
    one = {"w": np.sqrt(0.5), "x": 0.0, "y": 0.0, "z": np.sqrt(0.5)}
    quaternion = np.tile([one[part] for part in order], (COUNT, 1))
    path = save(tmp_path / "a.npz", arrays(euler_deg=None, quaternion=quaternion))
    with pytest.raises(InputError, match=r"set import\.quaternion"):
        read_numpy(path, PLAIN)
    settings = ImportSettings(quaternion=order)
    poses = to_poses(read_numpy(path, settings).columns, settings)
    np.testing.assert_allclose(poses.rotations[0] @ [1, 0, 0], [0, 1, 0], atol=1e-12)


@pytest.mark.parametrize(
    ("changes", "words"),
    [
        ({"waveform": None}, "holds no array waveform; it holds euler_deg"),
        ({"waveform": np.zeros(5)}, "waveform has shape"),
        ({"sampling_rate": None}, "holds no sampling_rate"),
        ({"sampling_rate": -1.0}, "expected one number above 0"),
        ({"position_mm": np.zeros((3, 3)), "euler_deg": np.zeros((3, 3))}, "4 pings and 3 poses"),
        ({"position_mm": np.zeros((3, 3))}, "differ in length: position_mm 3, euler_deg 4"),
        ({"position_mm": np.zeros((4, 2))}, "position_mm has shape"),
        ({"position_mm": np.full((4, 3), np.nan)}, "not finite"),
        ({"position_mm": None, "position": np.zeros((4, 3))}, "column x has no unit"),
        ({"start": np.zeros(3)}, "start has 3 values, expected 1 or 4"),
        ({"speed": np.zeros(4)}, "unknown column 'speed'"),
    ],
)
def test_what_does_not_fit_is_told(tmp_path, changes, words):
    with pytest.raises(InputError) as caught:
        read_numpy(save(tmp_path / "a.npz", arrays(**changes)), PLAIN)
    assert words in str(caught.value)
    assert "\n" not in str(caught.value)
