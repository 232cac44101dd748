# SPDX-License-Identifier: MIT
"""Files of the two MATLAB programs: poses in degrees, places of all microphones, responses."""

from __future__ import annotations

import numpy as np
import pytest
import scipy.io

from sononerf.errors import InputError
from sononerf.geometry.poses import rotation_from_euler
from sononerf.recordings.pose_tables import to_poses
from sononerf.recordings.readers import read_sononerf_matlab, read_sonotracelab
from sononerf.settings.sections import ImportSettings
from tests.matlab_writer import write_new

PLAIN = ImportSettings()
MICROPHONES = np.array([[-0.01, 0.01, 0.005], [-0.01, -0.01, 0.005], [0.0, 0.0, 0.01]])


def sensor(index):
    return {
        "position": np.array([[0.1 * index, 0.2, 0.3]]),
        "orientation": np.array([[0.0, 10.0, 90.0]]).T,  # roll, pitch, yaw
        "coordsEmitter": np.array([[0.0, 0.0, -0.01]]),
        "coordsReceivers": MICROPHONES,
    }


def responses(index):
    return np.random.default_rng(index).standard_normal((40, 3))


def sononerf_file(path, count=3, **changes):
    pings = [
        {"impulseResponse": responses(index), "sensorInfo": {**sensor(index), **changes}}
        for index in range(count)
    ]
    return write_new(path, {"dataStorageMatrix": pings})


def assert_read(found):
    assert len(found) == 3
    np.testing.assert_allclose(found.read(2), responses(2).T)
    poses = to_poses(found.columns, PLAIN)
    np.testing.assert_allclose(poses.positions[2], [0.2, 0.2, 0.3])
    expected = rotation_from_euler(np.pi / 2, np.radians(10), 0.0)
    np.testing.assert_allclose(poses.rotations[0], expected, atol=1e-12)
    assert found.settings["ears"]["receivers"] == MICROPHONES.tolist()
    assert found.settings["ears"]["emitter"] == [0, 0, -0.01]
    assert found.settings["ears"]["directivity"] == "omnidirectional"


def test_sononerf(tmp_path):
    found = read_sononerf_matlab(sononerf_file(tmp_path / "a.mat"), PLAIN)
    assert_read(found)
    assert (found.sampling_rate, found.settings["air"]) == (1e6, {"speed_of_sound": 343.0})


def workspace(count=3, **changes):
    def cell(values):
        made = np.zeros((1, len(values)), dtype=object)
        made[0, :] = values
        return made

    said = {"sampleRateImpresp": 450e3, "speedOfSound": 340.0}
    return {
        "structSensor": cell([sensor(index) for index in range(count)]),
        "structSimulationResult": cell([{"impulseResponse": responses(i)} for i in range(3)]),
        "structSimulationParameters": {**said, **changes},
    }


def test_sonotracelab(tmp_path):
    scipy.io.savemat(tmp_path / "a.mat", workspace())
    found = read_sonotracelab(tmp_path / "a.mat", PLAIN)
    assert_read(found)
    assert (found.sampling_rate, found.settings["air"]) == (450e3, {"speed_of_sound": 340.0})


def test_what_does_not_fit_is_told(tmp_path):
    path = tmp_path / "a.mat"
    sononerf_file(path, coordsReceivers=MICROPHONES[:2])
    with pytest.raises(InputError, match="3 channels, coordsReceivers 2 places"):
        read_sononerf_matlab(path, PLAIN)
    sononerf_file(path, position=np.zeros((1, 2)))
    with pytest.raises(InputError, match="position has 2 values, expected 3"):
        read_sononerf_matlab(path, PLAIN)
    with pytest.raises(InputError, match="is it of the format sononerf-matlab"):
        read_sonotracelab(path, PLAIN)
    write_new(path, {"dataStorageMatrix": [{"other": np.eye(2)}]})
    with pytest.raises(InputError, match="a ping has no sensorInfo"):
        read_sononerf_matlab(path, PLAIN)
    scipy.io.savemat(path, workspace(count=2))
    with pytest.raises(InputError, match="3 pings and 2 poses"):
        read_sonotracelab(path, PLAIN)
    with pytest.raises(InputError, match="is it of the format sonotracelab"):
        read_sononerf_matlab(path, PLAIN)
