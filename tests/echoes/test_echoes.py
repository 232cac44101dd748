# SPDX-License-Identifier: MIT
from __future__ import annotations

import numpy as np
import pytest

from sononerf.echoes.echoes import Echoes
from sononerf.echoes.region import echo_extent
from sononerf.echoes.store import EnsembleStore
from sononerf.errors import IncompatibleError, InputError, NumericalError
from sononerf.field.module import EchoModule
from sononerf.geometry.poses import Poses
from sononerf.head.head import Head
from sononerf.progress import Progress
from sononerf.scene.scene import load_scene
from sononerf.simulation.ensemble import simulate
from tests.memory import echoes_of


def store_of(path, split):
    count = len(split)
    store = EnsembleStore.create(
        path,
        positions=np.random.default_rng(0).standard_normal((count, 3)),
        rotations=np.broadcast_to(np.eye(3), (count, 3, 3)),
        split=split,
        range=np.linspace(0.2, 0.3, 5),
        frequency=np.linspace(1e4, 2e4, 3),
        attributes={"echo_hash": "a"},
    )
    for number in range(count):
        store.write_pose(number, np.full((2, 5, 3), float(number)))
    return store


def test_poses_come_from_their_splits(tmp_path):
    echoes = Echoes(store_of(tmp_path / "s", [0, 0, 1, 2, 0]), None)
    assert echoes.training.tolist() == [0, 1, 4]
    assert echoes.validation.tolist() == [2]
    assert float(echoes.magnitude(4).mean()) == 4.0


def test_without_validation_poses_some_of_training_are_held_back(tmp_path):
    echoes = Echoes(store_of(tmp_path / "s", [0] * 25), None)
    assert len(echoes.validation) >= 2
    assert len(echoes.training) + len(echoes.validation) == 25
    assert not set(echoes.training) & set(echoes.validation)


def test_all_training_poses_come_in_turn_and_the_step_alone_decides():
    numbers, split = np.arange(23), [0] * 20 + [1] * 3
    echoes = echoes_of(None, np.zeros((23, 3)), np.zeros((23, 3, 3)), None, split)
    drawn = np.concatenate([echoes.batch(3, step, 8) for step in range(5)])
    assert sorted(drawn[:20]) == sorted(drawn[20:40]) == numbers[:20].tolist()
    assert drawn[:20].tolist() != drawn[20:40].tolist()
    assert echoes.batch(3, 4, 8).tolist() == drawn[32:].tolist()
    assert echoes.batch(4, 0, 8).tolist() != drawn[:8].tolist()
    assert len(echoes.batch(0, 0, 50)) == 20


def test_onsets_before_a_box_are_clutter_and_the_box_is_the_region(tmp_path):
    """A click in front of a point that 40 poses hear."""
    head = Head({"receivers": [(0.0, 0.0, 0.0)], "emitter": (0.0, 0.0, 0.0)})
    poses = Poses.sphere(40, radius=0.4)
    window = head.point_echo.window
    offset = (np.arange(len(window)) - (len(window) - 1) / 2) * head.point_echo.spacing

    def echo(at):
        return np.interp(head.range - at, offset, window, left=0.0, right=0.0)

    clicks = np.linspace(0.30, 0.36, 40)  # a precursor would keep its distance
    power = np.stack([echo(0.4) + 0.1 * echo(at) + 1e-9 for at in clicks])
    heard = np.sqrt(power)[:, None, :, None] * np.ones(len(head.frequency))
    echoes = Echoes.from_arrays(heard, poses, head, split=[0] * 36 + [1, 1, 2, 2])
    np.testing.assert_allclose(echoes.hull.first[:, 0], clicks[:36], atol=2e-3)
    box = np.array([[-0.01] * 3, [0.01] * 3])
    within = echoes.within(box)
    np.testing.assert_allclose(within.hull.first, 0.4, atol=2e-3)
    assert (within.hull.weight == 1.0).all()
    np.testing.assert_allclose(EchoModule.for_echoes(within).field.region, box, atol=1e-7)
    assert echoes.box is None
    with pytest.raises(InputError, match=r"box: found .* expected a lower and an upper corner"):
        echoes.within(box[::-1])


HEAD = Head(
    ears={"receivers": [(0.0, 0.02, 0.0)], "directivity": "omnidirectional"},
    call={"kind": "hyperbolic", "duration": 4e-4},
    air={"temperature_c": 25.0},
    spectrogram={"range_min": 0.3, "range_max": 0.36},
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
    # One sphere sends nothing after the first bounce, so there is no noise of rays.
    assert written.store.attributes["noise_floor_mae_db"] == 0


AXIS = 0.2 + 0.001 * np.arange(600)
LOOKS = 4.0


def power_of(centres, level=1e4):
    """Echoes 20 mm wide in gamma-distributed noise, (P, 1, R)."""
    noise = np.random.default_rng(0).gamma(LOOKS, 1 / LOOKS, (len(centres), 1, len(AXIS)))
    shape = np.exp(-(((AXIS - np.asarray(centres)[:, None]) / 0.004) ** 2))
    return noise + level * shape[:, None]


def test_limits_lie_around_the_echoes():
    low, high = echo_extent(power_of(np.linspace(0.4, 0.55, 80)), AXIS, LOOKS, 0.01)
    assert 0.365 < low < 0.395
    assert 0.555 < high < 0.585


def test_one_ping_of_many_does_not_widen_them():
    centres = np.full(120, 0.5)
    centres[7] = 0.75
    low, high = echo_extent(power_of(centres), AXIS, LOOKS, 0.01)
    assert 0.46 < low < 0.5 < high < 0.54


def test_silence_leaves_the_axis_whole():
    limits = echo_extent(power_of(np.full(10, 0.5), level=0.0), AXIS, LOOKS, 0.01)
    assert limits == (AXIS[0], AXIS[-1])
