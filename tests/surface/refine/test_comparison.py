# SPDX-License-Identifier: MIT
from __future__ import annotations

import numpy as np
import pytest
import trimesh

from sononerf.errors import SonoNerfError
from sononerf.surface.refine import comparison as module
from sononerf.surface.refine.comparison import Comparison
from sononerf.surface.refine.objective import Level
from tests.memory import changed
from tests.surface.conftest import RADIUS


@pytest.fixture(autouse=True)
def few_rays(monkeypatch):
    monkeypatch.setattr(module, "RAYS", 4000)


@pytest.fixture
def level(optics):
    return Level(optics.ears, len(optics.frequencies), optics.get_buffer("wavenumber"))


def ball(radius):
    return trimesh.creation.icosphere(subdivisions=4, radius=radius)


def test_the_farther_from_the_truth_the_worse(echoes, optics, level):
    compared = Comparison(echoes, optics, seed=0)
    found = [
        compared.objective(ball(RADIUS + off), level, smooth=True) for off in (0.0, 5e-4, 2e-3)
    ]
    assert found[0] < 0.7
    assert found == sorted(found)


def test_training_poses_take_no_part(echoes, optics, level):
    compared = Comparison(echoes, optics, seed=0)
    assert set(compared.poses) <= set(echoes.validation)


def test_a_surface_that_cannot_be_traced_is_an_error(echoes, optics, level):
    flat = trimesh.Trimesh(np.zeros((3, 3)), [[0, 1, 2]], process=False)
    with pytest.raises(SonoNerfError):
        Comparison(echoes, optics, seed=0).objective(flat, level, smooth=False)


def test_without_an_absolute_level_one_gain_is_found(echoes, optics, level):
    louder, free = (
        changed(echoes, read=lambda n: 8 * echoes.store.read_pose(n), origin=origin)
        for origin in ("simulated", "recorded")
    )
    wrong = Comparison(louder, optics, seed=0).objective(ball(RADIUS), level, smooth=True)
    right = Comparison(echoes, optics, seed=0).objective(ball(RADIUS), level, smooth=True)
    found = Comparison(free, optics, seed=0).objective(ball(RADIUS), level, smooth=True)
    assert found < right + 0.3 < wrong - 2.0
