# SPDX-License-Identifier: MIT
"""What is heard less what the surroundings alone send back."""

from __future__ import annotations

import pickle

import numpy as np
import pytest

from sononerf.echoes.store import EnsembleStore, SubtractedStore
from sononerf.errors import IncompatibleError, InputError, NumericalError
from tests.echoes.test_store import POSES, axes, spectrogram


def store(path, values, *, poses=range(POSES), **changes):
    attributes = {"echo_hash": path.name, "reference": 2e-3, "noise_floor_mae_db": 0.1}
    made = EnsembleStore.create(path, **axes(attributes=attributes, **changes))
    for index in poses:
        made.write_pose(index, values(index))
    return path


@pytest.fixture
def whole(tmp_path):
    """The loudest cell of the training poses is 2."""

    def loud(index):
        values = spectrogram(index)
        values.flat[0] = 2.0
        return values

    return store(tmp_path / "whole", loud)


def test_power_is_taken_off_and_nothing_is_less_than_silent(whole, tmp_path):
    """0.6² + 0.8² = 1; what sounded louder alone is silent."""
    alone = store(tmp_path / "alone", lambda i: np.full_like(spectrogram(i), 0.6))
    left = SubtractedStore(whole, alone)
    for index in (0, POSES - 1):
        together = EnsembleStore.open(whole).read_pose(index)
        found = left.read_pose(index)
        assert found.dtype == np.float32
        loud = together > 0.6
        np.testing.assert_allclose(found[loud] ** 2 + 0.36, together[loud] ** 2, rtol=1e-5)
        assert not found[~loud].any()
        assert 0 < loud.mean() < 1


def test_the_reference_is_that_of_what_is_left_and_the_floor_is_not_known(whole, tmp_path):
    def alone(index):
        """All of the loudest cell but a hundredth of its power, nothing else."""
        values = np.zeros_like(spectrogram(index))
        values.flat[0] = np.sqrt(4.0 - 0.04)
        return values

    left = SubtractedStore(whole, store(tmp_path / "alone", alone))
    loudest = max(left.read_pose(int(i)).max() for i in left.indices("train"))
    assert loudest < 1.0
    assert left.attributes["reference"] == pytest.approx(1e-3 * loudest, rel=1e-6)
    assert left.attributes["noise_floor_mae_db"] is None
    assert left.attributes["noise_floor_mae_db_active"] is None
    assert left.attributes["echo_hash"] == "whole"


def test_it_goes_to_other_processes_whole(whole, tmp_path):
    alone = store(tmp_path / "alone", lambda i: np.full_like(spectrogram(i), 0.6))
    left = SubtractedStore(whole, alone)
    again = pickle.loads(pickle.dumps(left))
    np.testing.assert_array_equal(again.read_pose(3), left.read_pose(3))


@pytest.mark.parametrize(
    ("changes", "name"),
    [
        ({"poses_positions": np.zeros((POSES, 3))}, "position"),
        ({"split": np.zeros(POSES, int)}, "split"),
        ({"frequency": np.linspace(10e3, 90e3, 5)}, "frequency"),
    ],
)
def test_a_background_of_other_poses_or_axes_is_refused(whole, tmp_path, changes, name):
    other = store(tmp_path / "other", spectrogram, **changes)
    with pytest.raises(IncompatibleError, match=f"other: its {name} differs from that of") as error:
        SubtractedStore(whole, other)
    assert "\n" not in str(error.value)


def test_a_background_that_is_not_whole_is_refused(whole, tmp_path):
    part = store(tmp_path / "part", spectrogram, poses=[0, 1, 3])
    with pytest.raises(InputError, match="pose 2 is missing; finish it"):
        SubtractedStore(whole, part)
    with pytest.raises(InputError, match="no ensemble store"):
        SubtractedStore(whole, tmp_path / "nowhere")


def test_the_same_ensemble_leaves_nothing(whole):
    with pytest.raises(NumericalError, match="nothing is left; is it the same ensemble"):
        _ = SubtractedStore(whole, whole).attributes
