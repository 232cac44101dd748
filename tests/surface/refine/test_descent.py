# SPDX-License-Identifier: MIT
from __future__ import annotations

import numpy as np
import pytest
import torch
import trimesh

from sononerf.surface.refine.descent import Descent, poses_that_hear
from sononerf.surface.refine.objective import Level, OnsetRanges
from sononerf.surface.refine.remesh import remesh
from tests.memory import changed
from tests.surface.conftest import RADIUS
from tests.surface.refine.test_objective import heard as onsets_of


@pytest.fixture(scope="module")
def too_large():
    return remesh(trimesh.creation.icosphere(subdivisions=4, radius=RADIUS + 4e-4), 2.5e-3)


def descent_on(mesh, echoes, optics):
    level = Level(optics.ears, len(optics.frequencies), optics.get_buffer("wavenumber"))
    level.learns = "none"
    smoothing = 1.5 * optics.wavelength
    return Descent(mesh, echoes, optics, level, smoothing=smoothing, rate=0.02, seed=0)


def off(descent, heard):
    return float((descent.vertices[heard].norm(dim=1) - RADIUS).abs().mean())


def test_a_sphere_that_is_too_large_shrinks_to_what_is_heard(too_large, echoes, optics):
    work = descent_on(too_large, echoes, optics)
    heard = poses_that_hear(too_large, echoes, optics) > 0
    assert 0.05 < float(heard.double().mean()) < 1.0
    before = off(work, heard)
    errors = [work.step(number, number / 25) for number in range(25)]
    assert off(work, heard) < 0.4 * before
    assert np.mean(errors[-5:]) < 0.7 * np.mean(errors[:3])


def test_where_nobody_listens_nothing_moves(too_large, echoes, optics):
    places = echoes.positions[echoes.training]
    some = echoes.training[places[:, 2] > 0.1]
    split = np.full(len(echoes.positions), 1)
    split[some] = 0
    upper = changed(echoes, split=split)
    work = descent_on(too_large, upper, optics)
    start = work.vertices.clone()
    for number in range(6):
        work.step(number, 0.0)
    moved = ((work.vertices - start) * torch.nn.functional.normalize(start, dim=1)).sum(1).abs()
    below = start[:, 2] < -0.6 * RADIUS
    above = start[:, 2] > 0.3 * RADIUS
    assert float(moved[below].mean()) < 0.35 * float(moved[above].mean())


def test_onsets_move_the_surface_to_where_it_must_begin(echoes, optics):
    ball = trimesh.creation.icosphere(subdivisions=4, radius=RADIUS)
    onsets = OnsetRanges(
        onsets_of(trimesh.creation.icosphere(subdivisions=4, radius=RADIUS + 1e-3)), 0.006, seed=0
    )
    sizes = []
    for known in (None, onsets):
        level = Level(optics.ears, len(optics.frequencies), optics.get_buffer("wavenumber"))
        work = Descent(
            ball, echoes, optics, level, smoothing=0.004, rate=0.02, onsets=known, seed=0
        )
        for number in range(5):
            work.step(number, 0.0)
        sizes.append(float(work.vertices.norm(dim=1).mean()))
    assert sizes[1] > sizes[0] + 5e-5
