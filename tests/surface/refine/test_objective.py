# SPDX-License-Identifier: MIT
from __future__ import annotations

import numpy as np
import pytest
import torch

from sononerf.surface.refine.objective import Level, measured, mismatch
from sononerf.surface.refine.optics import Heard
from tests.memory import echoes_of


def example(gain=1.0, poses=3):
    power = torch.as_tensor(np.random.default_rng(0).random((poses, 2, 12, 4))).float() + 0.05
    heard = Heard(power, torch.tensor([4] * poses))
    whole = np.zeros((poses, 2, 20, 4), np.float32)
    whole[:, :, 4:16] = gain * power.sqrt().numpy()
    echoes = echoes_of(None, np.zeros((poses, 3)), np.zeros((poses, 3, 3)), lambda i: whole[i])
    return heard, echoes


def test_what_is_rendered_as_measured_has_no_mismatch():
    heard, echoes = example()
    level = Level(2, 4, heard.power)
    errors = mismatch(heard, None, measured(echoes, [0, 1, 2], heard), level, learn=False)
    assert float(errors.max()) < 1e-3


def test_a_gain_is_learned():
    heard, echoes = example(gain=2.0)
    level = Level(2, 4, heard.power)
    found = measured(echoes, [0, 1, 2], heard)
    before = float(mismatch(heard, None, found, level, learn=False).mean())
    for _ in range(60):
        mismatch(heard, None, found, level, learn=True)
    after = float(mismatch(heard, None, found, level, learn=False).mean())
    assert level.gain.exp().numpy() == pytest.approx(2.0, rel=0.05)
    assert after < 0.1 * before


def test_later_bounces_add_power():
    heard, echoes = example(gain=np.sqrt(2.0))
    level = Level(2, 4, heard.power)
    found = measured(echoes, [0, 1, 2], heard)
    errors = mismatch(heard, heard.power.clone(), found, level, learn=False)
    assert float(errors.max()) < 1e-3


def test_frequencies_that_are_always_wrong_count_less():
    heard, echoes = example()
    found = measured(echoes, [0, 1, 2], heard)
    magnitude = found[0].clone()
    magnitude[..., 0] *= 0.2
    level = Level(2, 4, heard.power)
    level.gain[:] = 0.0
    for _ in range(60):
        mismatch(heard, None, (magnitude, *found[1:]), level, learn=True)
        level.gain[:] = 0.0
    assert float(level.weight[:, 0].max()) < 0.2 * float(level.weight[:, 1:].min())


def test_rows_beyond_the_axis_do_not_count():
    heard, echoes = example()
    early = Heard(heard.power, heard.row - 10)
    magnitude, inside, loudest = measured(echoes, [0, 1, 2], early)
    assert inside[0, 0, :, 0].tolist() == [False] * 6 + [True] * 6
    assert float(magnitude[:, :, :6].max()) == 0.0
    assert loudest.shape == (3,)


def test_a_level_is_taken_over_whole():
    heard, echoes = example(gain=1.5)
    level, other = Level(2, 4, heard.power), Level(2, 4, heard.power)
    mismatch(heard, None, measured(echoes, [0, 1, 2], heard), level, learn=True)
    other.load(level.state())
    assert torch.equal(level.gain, other.gain)
    assert torch.equal(level.error, other.error)
    assert level.steps == other.steps == 1
