# SPDX-License-Identifier: MIT
"""Echoes from arrays of one's own, simulated in memory, saved and opened again."""

from __future__ import annotations

import numpy as np
import pytest

from sononerf.echoes.echoes import Echoes
from sononerf.errors import IncompatibleError, InputError, NumericalError
from sononerf.geometry.poses import Poses
from sononerf.head.head import Head
from sononerf.progress import Progress
from sononerf.scene.scene import load_scene
from sononerf.simulation.ensemble import simulate

HEAD = Head(
    ears={"receivers": [(0.0, 0.02, 0.0)], "directivity": "omnidirectional"},
    call={"kind": "hyperbolic", "duration": 4e-4},
    air={"temperature_c": 25.0},
    analysis={"range_min": 0.3, "range_max": 0.36},
)
POSES = Poses.sphere(12, radius=0.35)


@pytest.fixture
def heard():
    shape = (len(POSES), 1, len(HEAD.range), len(HEAD.frequency))
    return np.random.default_rng(0).uniform(0.1, 1.0, shape).astype(np.float32)


def test_arrays_become_echoes_and_come_back_from_disk(heard, tmp_path):
    split = ["train"] * 9 + ["val", "test", "test"]
    echoes = Echoes.from_arrays(heard, POSES, HEAD, split=split)
    echoes.save(tmp_path / "store")
    echoes.save(tmp_path / "store")  # the same echoes
    opened = Echoes.open(tmp_path / "store")
    for found in (echoes, opened):
        assert len(found) == 12
        np.testing.assert_array_equal(found.spectrogram(3), heard[3])
        np.testing.assert_array_equal(found.poses("test").positions, POSES.positions[10:])
        assert found.numbers_of(found.poses("val")).tolist() == [9]
        assert len(found.poses()) == 12
        assert not found.calibrated
        # m0 is 60 dB below the loudest training pose.
        assert found.reference == pytest.approx(1e-3 * heard[:9].max())
    assert opened.head.plain() == HEAD.plain()
    assert opened.head.speed_of_sound == HEAD.speed_of_sound
    other = Echoes.from_arrays(heard / 2, POSES, HEAD, split=split)
    with pytest.raises(IncompatibleError, match="holds echoes of other settings"):
        other.save(tmp_path / "store")


def test_a_pose_that_was_not_heard_has_no_number(heard):
    echoes = Echoes.from_arrays(heard, POSES, HEAD)
    with pytest.raises(InputError, match="pose 0 is not among the 12 poses"):
        echoes.numbers_of(Poses.sphere(3, radius=0.4))


def test_repeated_poses_give_the_noise_floor(heard):
    twice = Poses(np.repeat(POSES.positions, 2, 0), np.repeat(POSES.rotations, 2, 0))
    again = np.repeat(heard, 2, axis=0)
    again[1::2] *= 1.1
    echoes = Echoes.from_arrays(again, twice, HEAD)
    floor = echoes.store.attributes["noise_floor_mae_db"]
    assert floor == pytest.approx(20 * np.log10(1.1), rel=0.05)


@pytest.mark.parametrize(
    ("spoil", "error", "message"),
    [
        (lambda a: a[:, 0], InputError, r"expected \(poses, receivers, ranges, frequencies\)"),
        (lambda a: a[:5], InputError, r"shape \(5, 1, "),
        (lambda a: -a, InputError, "pose 0 has magnitudes below 0"),
        (lambda a: a * 1j, InputError, "complex"),
        (lambda a: np.where(a == a.max(), np.nan, a), NumericalError, "holds the magnitude nan"),
        (lambda a: 0 * a, NumericalError, "all training poses are silent"),
    ],
)
def test_wrong_arrays_are_refused(heard, spoil, error, message):
    with pytest.raises(error, match=message):
        Echoes.from_arrays(spoil(heard), POSES, HEAD)


def test_a_folder_without_echoes_is_refused(tmp_path):
    with pytest.raises(InputError, match="no ensemble store"):
        Echoes.open(tmp_path)


def test_simulated_in_memory_and_on_disk_are_the_same(tmp_path):
    given = {
        "scene": load_scene("sphere", {"radius": 0.02}),
        "poses": POSES[:6],
        "head": HEAD,
        "options": {"engine": "rays", "rays": 500},
        "workers": 1,
        "progress": Progress(quiet=True),
    }
    kept, written = simulate(**given), simulate(**given, output=tmp_path / "store")
    assert kept.calibrated
    assert kept.reference == written.reference
    for pose in range(6):
        np.testing.assert_array_equal(kept.spectrogram(pose), written.spectrogram(pose))
    kept.save(tmp_path / "store")  # it takes them for the same echoes
    kept.save(tmp_path / "copy")
    assert Echoes.open(tmp_path / "copy").store.attributes == written.store.attributes
    assert written.store.attributes["noise_floor_mae_db"] > 0
