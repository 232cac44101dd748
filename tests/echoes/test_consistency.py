# SPDX-License-Identifier: MIT
from dataclasses import replace

import numpy as np
import pytest

from sononerf.echoes.consistency import weighted
from sononerf.echoes.free_space import EchoHull
from sononerf.geometry.directions import fibonacci_sphere

AWAY = 0.4
LENGTHS = np.array([0.04, 0.025, 0.003])
"""Half axes of a flat body, m."""
RESOLUTION = 0.006


def heard(count=60, scale=1.0):
    """Heads around a flat body, two ears each; every onset from its nearest point."""
    ways = fibonacci_sphere(count)
    emitters = AWAY * ways
    sideways = np.cross(ways, [0.3, 0.5, 0.8])
    sideways /= np.linalg.norm(sideways, axis=1, keepdims=True)
    receivers = emitters[:, None] + 0.01 * np.stack((sideways, -sideways), axis=1)
    points = fibonacci_sphere(20_000) * LENGTHS
    out = np.linalg.norm(points[None] - emitters[:, None], axis=2)
    back = np.linalg.norm(points[None, None] - receivers[:, :, None], axis=3)
    first = ((out[:, None] + back) / 2).min(axis=2)
    return EchoHull(scale * emitters, scale * receivers, scale * first, -ways)


@pytest.fixture(scope="module")
def hull():
    return heard()


def delayed(hull, poses, by, ears=slice(None)):
    first = hull.first.copy()
    first[poses, ears] += by
    return replace(hull, first=first)


def outliers(hull, resolution=RESOLUTION):
    return weighted(hull, resolution).weight == 0.0


def test_nobody_is_an_outlier_where_all_heard_the_nearest_point(hull):
    assert not outliers(hull).any()


@pytest.mark.parametrize("poses", [[7], [3, 20, 41]])
def test_a_late_onset_is_known_by_the_places_that_others_heard(hull, poses):
    expected = np.zeros(hull.first.shape, dtype=bool)
    expected[poses] = True
    np.testing.assert_array_equal(outliers(delayed(hull, poses, 0.008)), expected)


def test_each_ear_is_judged_alone(hull):
    found = outliers(delayed(hull, [7], 0.008, ears=1))
    assert found[7].tolist() == [False, True]
    assert found.sum() == 1


def test_the_body_is_not_cut_by_late_onsets(hull):
    points = fibonacci_sphere(2000) * LENGTHS
    wrong = delayed(hull, [3, 20, 41], 0.012)
    assert wrong.clearance(points)[0].min() < -0.010
    assert weighted(wrong, RESOLUTION).clearance(points)[0].min() > -RESOLUTION / 4


def test_one_far_too_early_is_an_outlier_and_takes_nobody_along(hull):
    """A click 0.1 m in front of the body: nothing can be there, for all others heard past it."""
    found = outliers(delayed(hull, [24], -0.1))
    assert found[24].all()
    assert found.sum() == 2


def test_unknown_onsets_stay_unknown(hull):
    deaf = hull.first.copy()
    deaf[5] = -np.inf
    found = weighted(EchoHull(hull.emitters, hull.receivers, deaf, hull.axes), RESOLUTION)
    np.testing.assert_array_equal(found.weight == 0.0, ~np.isfinite(deaf))
    nothing = np.full_like(deaf, -np.inf)
    silent = EchoHull(hull.emitters, hull.receivers, nothing, hull.axes)
    assert not weighted(silent, RESOLUTION).weight.any()


def test_a_world_three_times_as_large_has_the_same_outliers(hull):
    late = delayed(hull, [3, 20, 41], 0.008)
    large = delayed(heard(scale=3.0), [3, 20, 41], 0.024)
    np.testing.assert_array_equal(
        weighted(large, 3 * RESOLUTION).weight, weighted(late, RESOLUTION).weight
    )
