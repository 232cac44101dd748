# SPDX-License-Identifier: MIT
from __future__ import annotations

import numpy as np
import pytest
import trimesh

from sononerf.errors import SonoNerfError
from sononerf.refinement import objective as module
from sononerf.refinement.objective import ErrorLevel, OnsetRanges, SurfaceComparison
from tests.memory import changed, deaf_hull
from tests.refinement.conftest import RADIUS
from tests.refinement.test_objective import heard


@pytest.fixture(autouse=True)
def few_rays(monkeypatch):
    monkeypatch.setattr(module, "RAYS", 4000)


@pytest.fixture
def level(optics):
    return ErrorLevel(optics.ears, len(optics.frequencies), optics.get_buffer("wavenumber"))


@pytest.fixture
def silent(optics):
    """No onsets."""
    return OnsetRanges(deaf_hull(), optics.head.resolution, seed=0)


def ball(radius):
    return trimesh.creation.icosphere(subdivisions=4, radius=radius)


def test_the_farther_from_the_truth_the_worse(echoes, optics, level, silent):
    compared = SurfaceComparison(echoes, optics, silent, seed=0)
    found = [
        compared.objective(ball(RADIUS + off), level, smooth=True) for off in (0.0, 5e-4, 2e-3)
    ]
    assert found[0] < 0.7
    assert found == sorted(found)


def test_onsets_count_beside_the_echoes(echoes, optics, level, silent):
    onsets = OnsetRanges(heard(ball(0.02)), optics.head.resolution, seed=0)
    mesh = ball(RADIUS)
    without = SurfaceComparison(echoes, optics, silent, seed=0).objective(mesh, level, smooth=True)
    beside = SurfaceComparison(echoes, optics, onsets, seed=0).objective(mesh, level, smooth=True)
    assert beside > without + 3.0
    compared = SurfaceComparison(echoes, optics, onsets, seed=0)
    assert compared.error(mesh, level, smooth=True) == without
    assert compared.misfit(mesh) == pytest.approx(beside - without)


def test_training_poses_take_no_part(echoes, optics, level, silent):
    compared = SurfaceComparison(echoes, optics, silent, seed=0)
    assert set(compared.poses) <= set(echoes.validation)


def test_a_surface_that_cannot_be_traced_is_an_error(echoes, optics, level, silent):
    flat = trimesh.Trimesh(np.zeros((3, 3)), [[0, 1, 2]], process=False)
    with pytest.raises(SonoNerfError):
        SurfaceComparison(echoes, optics, silent, seed=0).objective(flat, level, smooth=False)


def test_without_an_absolute_level_one_gain_is_found(echoes, optics, level, silent):
    louder, free = (
        changed(echoes, read=lambda n: 8 * echoes.store.read_pose(n), origin=origin)
        for origin in ("simulated", "recorded")
    )
    wrong = SurfaceComparison(louder, optics, silent, seed=0).objective(
        ball(RADIUS), level, smooth=True
    )
    right = SurfaceComparison(echoes, optics, silent, seed=0).objective(
        ball(RADIUS), level, smooth=True
    )
    found = SurfaceComparison(free, optics, silent, seed=0).objective(
        ball(RADIUS), level, smooth=True
    )
    assert found < right + 0.3 < wrong - 2.0
