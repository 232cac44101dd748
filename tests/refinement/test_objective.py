# SPDX-License-Identifier: MIT


from __future__ import annotations

import numpy as np
import pytest
import torch
import trimesh

from sononerf.echoes.free_space import EchoHull
from sononerf.refinement.objective import (
    HUBER_SCALE,
    ErrorLevel,
    OnsetRanges,
    differences,
    measured,
    mismatch,
    over_band,
)
from sononerf.refinement.optics import Heard
from sononerf.refinement.surface_error import error_from_twice, surface_error
from tests.memory import changed, echoes_of
from tests.refinement.conftest import RADIUS


def example(gain=1.0, poses=3):
    power = torch.as_tensor(np.random.default_rng(0).random((poses, 2, 12, 4))).float() + 0.05
    heard = Heard(power, torch.tensor([4] * poses))
    whole = np.zeros((poses, 2, 20, 4), np.float32)
    whole[:, :, 4:16] = gain * power.sqrt().numpy()
    echoes = echoes_of(None, np.zeros((poses, 3)), np.zeros((poses, 3, 3)), lambda i: whole[i])
    return heard, echoes


def test_what_is_rendered_as_measured_has_no_mismatch():
    heard, echoes = example()
    level = ErrorLevel(2, 4, heard.power)
    errors = mismatch(
        *differences(heard, None, measured(echoes, [0, 1, 2], heard), level, learn=False)
    )
    assert float(errors.max()) < 1e-3


def test_a_gain_is_learned():
    heard, echoes = example(gain=2.0)
    level = ErrorLevel(2, 4, heard.power)
    found = measured(echoes, [0, 1, 2], heard)
    before = float(mismatch(*differences(heard, None, found, level, learn=False)).mean())
    for _ in range(60):
        differences(heard, None, found, level, learn=True)
    after = float(mismatch(*differences(heard, None, found, level, learn=False)).mean())
    assert level.gain.exp().numpy() == pytest.approx(2.0, rel=0.05)
    assert after < 0.1 * before


def test_later_bounces_add_power():
    heard, echoes = example(gain=np.sqrt(2.0))
    level = ErrorLevel(2, 4, heard.power)
    found = measured(echoes, [0, 1, 2], heard)
    errors = mismatch(*differences(heard, heard.power.clone(), found, level, learn=False))
    assert float(errors.max()) < 1e-3


def test_frequencies_that_are_always_wrong_count_less():
    heard, echoes = example()
    found = measured(echoes, [0, 1, 2], heard)
    magnitude = found[0].clone()
    magnitude[..., 0] *= 0.2
    level = ErrorLevel(2, 4, heard.power)
    level.gain[:] = 0.0
    for _ in range(60):
        differences(heard, None, (magnitude, *found[1:]), level, learn=True)
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
    level, other = ErrorLevel(2, 4, heard.power), ErrorLevel(2, 4, heard.power)
    differences(heard, None, measured(echoes, [0, 1, 2], heard), level, learn=True)
    other.load(level.state())
    assert torch.equal(level.gain, other.gain)
    assert torch.equal(level.error, other.error)
    assert level.steps == other.steps == 1


RESOLUTION = 0.006


def vertices_of(mesh):
    return torch.as_tensor(np.array(mesh.vertices, dtype=np.float64))


def heard(mesh, count=40, weight=None):
    """Onsets of a mesh from all around, without error."""
    way = np.random.default_rng(3).normal(size=(count, 3))
    places = 0.4 * way / np.linalg.norm(way, axis=1, keepdims=True)
    beside = np.array([0.0, 0.01, 0.0])
    ears = np.stack([places + beside, places - beside], axis=1)
    far = np.linalg.norm(mesh.vertices[:, None] - places, axis=2)[..., None]
    far = (far + np.linalg.norm(mesh.vertices[:, None, None] - ears, axis=3)) / 2
    return EchoHull(places, ears, far.min(axis=0), -places / 0.4, weight=weight)


@pytest.fixture(scope="module")
def box():
    return trimesh.creation.box((0.06, 0.05, 0.04)).subdivide().subdivide().subdivide()


def test_the_body_itself_has_no_misfit_and_a_smaller_one_has(box):
    onsets = OnsetRanges(heard(box), RESOLUTION, seed=0)
    assert onsets.misfit(vertices_of(box)) == pytest.approx(0.0, abs=1e-9)
    off = 2.0 * HUBER_SCALE * RESOLUTION
    smaller = box.copy()
    smaller.vertices *= 1 - off / 0.04
    assert 0.5 < onsets.misfit(vertices_of(smaller)) < 2.5


def test_onsets_may_all_come_late_but_not_early(box):
    onsets = OnsetRanges(heard(box), RESOLUTION, seed=0)
    off = 2.0 * HUBER_SCALE * RESOLUTION
    larger, smaller = (box.copy().apply_scale(1 + side * off / 0.03) for side in (1, -1))
    before = onsets.misfit(vertices_of(larger))
    assert onsets.misfit(vertices_of(larger), late=2 * off) < 0.3 * before
    assert onsets.misfit(vertices_of(larger), late=0.1 * off) > 0.8 * before
    early = onsets.misfit(vertices_of(smaller))
    assert onsets.misfit(vertices_of(smaller), late=2 * off) == early


def test_going_against_the_gradient_lowers_the_misfit(box):
    onsets = OnsetRanges(heard(box), RESOLUTION, seed=0)
    places = vertices_of(box) * 0.97
    before = onsets.misfit(places)
    for step in range(200):
        slope = onsets.gradient(places, step)
        assert slope.shape == places.shape
        places = places - 1e-7 * slope
    assert onsets.misfit(places) < 0.7 * before


def test_the_gradient_is_that_of_the_misfit(box):
    onsets = OnsetRanges(heard(box, count=12), RESOLUTION, seed=0)
    places = vertices_of(box) * 0.999
    slope = onsets.gradient(places, 0)
    way = torch.randn(places.shape, generator=torch.Generator().manual_seed(1)).double()
    size = 1e-8
    change = onsets.misfit(places + size * way) - onsets.misfit(places - size * way)
    assert float((slope * way).sum()) == pytest.approx(change / (2 * size), rel=1e-3)


def test_outliers_take_no_part(box):
    right = heard(box)
    wrong = right.first.copy()
    wrong[::4] -= 0.05
    weight = np.ones_like(wrong)
    weight[::4] = 0.0
    hull = EchoHull(right.emitters, right.receivers, wrong, right.axes, weight=weight)
    assert OnsetRanges(hull, RESOLUTION, seed=0).misfit(vertices_of(box)) < 1e-9


def test_without_onsets_nothing_is_said(box):
    silent = heard(box, weight=np.zeros((40, 2)))
    onsets = OnsetRanges(silent, RESOLUTION, seed=0)
    assert len(onsets) == 0
    assert onsets.misfit(vertices_of(box)) == 0.0
    assert not onsets.gradient(vertices_of(box), 0).any()


def test_a_step_draws_its_onsets_by_its_number(box):
    onsets = OnsetRanges(heard(box, count=100), RESOLUTION, seed=0)
    places = vertices_of(box) * 0.97
    assert torch.equal(onsets.gradient(places, 4), onsets.gradient(places, 4))
    assert not torch.equal(onsets.gradient(places, 4), onsets.gradient(places, 5))


def test_power_is_averaged_over_a_part_of_the_frequencies():
    power = torch.rand(2, 1, 5, 14, generator=torch.Generator().manual_seed(0))
    found = over_band(power, 0.33)  # two frequencies on either side
    torch.testing.assert_close(found[..., 5], power[..., 3:8].mean(-1))
    first = (3.0 * power[..., 0] + power[..., 1] + power[..., 2]) / 5.0
    torch.testing.assert_close(found[..., 0], first)
    torch.testing.assert_close(over_band(power, 0.0), power)


def ball(height=lambda way: 0.0):
    mesh = trimesh.creation.icosphere(subdivisions=5, radius=RADIUS)
    way = np.asarray(mesh.vertices) / RADIUS
    return trimesh.Trimesh(way * (RADIUS + height(way))[:, None], mesh.faces, process=False)


@pytest.fixture(scope="module")
def right():
    return ball(lambda way: np.zeros(len(way)))


def of(mesh, echoes, optics, validation_db=2.0, seed=0, starts=()):
    return surface_error(
        mesh, echoes, optics, starts=starts, validation_db=validation_db, seed=seed
    )


def test_a_dent_has_a_larger_error_than_the_surface_around_it(right, echoes, optics):
    depth = 0.6 * optics.wavelength
    dented = ball(lambda way: -depth * np.exp(-((1 - way[:, 2]) / 0.1)))
    inside = right.vertices[:, 2] > 0.9 * RADIUS
    away = right.vertices[:, 2] < 0.0
    assert of(right, echoes, optics).heard.all()
    found = of(dented, echoes, optics).error
    assert np.median(found[inside]) > 1.25 * np.median(found[away])
    before = of(right, echoes, optics).error
    assert np.median(before[inside]) < 1.1 * np.median(before[away])


def test_what_no_pose_hears_is_unheard(right, echoes, optics):
    above = changed(echoes, split=np.where(echoes.positions[:, 2] > 0.1, 0, 2))
    found = of(right, above, optics)
    top, bottom = right.vertices[:, 2] > 0.6 * RADIUS, right.vertices[:, 2] < -0.8 * RADIUS
    assert found.heard[top].mean() > 0.9
    assert not found.heard[bottom].any()


def test_the_error_grows_with_that_of_the_validation_poses(right, echoes, optics):
    low, high = (of(right, echoes, optics, validation_db=one).error for one in (1.0, 3.0))
    assert (high > 2.0 * low).all()


def test_the_error_is_larger_where_the_starts_are_elsewhere(right, echoes, optics):
    def start(height):
        return ball(lambda way: height * (way[:, 2] > 0.3))

    found = of(right, echoes, optics, starts=[start(2e-3), start(-2e-3), start(0.0)]).error
    before = of(right, echoes, optics, starts=[start(0.0), start(0.0), start(2e-3)]).error
    top, bottom = right.vertices[:, 2] > 0.6 * RADIUS, right.vertices[:, 2] < 0.0
    assert (found[top] > 1.5 * before[top]).all()
    assert np.allclose(found[bottom], before[bottom])


def test_the_same_seed_gives_the_same_error(right, echoes, optics):
    first, again = (of(right, echoes, optics, seed=4).error for _ in range(2))
    assert np.array_equal(first, again)


def test_twice_as_many_poses_help_less_where_the_error_is_small():
    wavelength = 4e-3
    errors = (1e-5, 1e-3, 1e-2)
    factor = [error_from_twice(one, wavelength) / one for one in errors]
    assert factor[0] == 1.0
    assert 1.0 > factor[1] > factor[2] > 0.3
    assert error_from_twice(2e-3, 2 * wavelength) == pytest.approx(2 * factor[1] * 1e-3)
