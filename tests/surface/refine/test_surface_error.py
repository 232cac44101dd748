# SPDX-License-Identifier: MIT
from __future__ import annotations

import numpy as np
import pytest
import trimesh

from sononerf.surface.refine.surface_error import error_from_twice, surface_error
from tests.memory import changed
from tests.surface.conftest import RADIUS


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
