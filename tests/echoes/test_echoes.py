# SPDX-License-Identifier: MIT
from __future__ import annotations

import numpy as np
import pytest

from sononerf.echoes.echoes import Echoes
from sononerf.echoes.store import EnsembleStore
from sononerf.errors import InputError
from sononerf.field.module import EchoModule
from sononerf.geometry.poses import Poses
from sononerf.head.head import Head
from tests.memory import echoes_of


def store_of(path, split):
    count = len(split)
    store = EnsembleStore.create(
        path,
        poses_positions=np.random.default_rng(0).standard_normal((count, 3)),
        poses_rotations=np.broadcast_to(np.eye(3), (count, 3, 3)),
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
