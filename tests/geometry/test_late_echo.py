# SPDX-License-Identifier: MIT
from dataclasses import replace

import numpy as np
import pytest

from sononerf.geometry import late_echo
from sononerf.geometry.directions import fibonacci_sphere
from sononerf.geometry.hull import EchoHull
from sononerf.geometry.late_echo import corrected, lateness

AWAY = 0.4
LENGTHS = np.array([0.04, 0.025, 0.003])
"""Half axes of a flat body, m."""
BOX = np.array([[-0.06, -0.05, -0.03], [0.06, 0.05, 0.03]])


def late(*given):
    return lateness(*given) > 0


def surface(count=20_000):
    return fibonacci_sphere(count) * LENGTHS


@pytest.fixture(scope="module")
def heard():
    """Sixty heads around a flat body, two ears each; every first echo from its nearest point."""
    ways = fibonacci_sphere(60)
    emitters = AWAY * ways
    sideways = np.cross(ways, [0.3, 0.5, 0.8])
    sideways /= np.linalg.norm(sideways, axis=1, keepdims=True)
    receivers = emitters[:, None] + 0.01 * np.stack((sideways, -sideways), axis=1)
    points = surface()
    out = np.linalg.norm(points[None] - emitters[:, None], axis=2)
    back = np.linalg.norm(points[None, None] - receivers[:, :, None], axis=3)
    first = ((out[:, None] + back) / 2).min(axis=2)
    return EchoHull(emitters, receivers, first, -ways)


def delayed(hull, poses, by, ears=slice(None)):
    first = hull.first.copy()
    first[poses, ears] += by
    return replace(hull, first=first)


def test_nobody_is_late_where_all_heard_the_nearest_point(heard):
    assert not late(heard, *BOX).any()
    np.testing.assert_array_equal(corrected(heard, *BOX).first, heard.first)


@pytest.mark.parametrize("poses", [[7], [3, 20, 41]])
def test_a_late_first_echo_is_known_by_the_places_that_others_heard(heard, poses):
    found = late(delayed(heard, poses, 0.008), *BOX)
    expected = np.zeros_like(found)
    expected[poses] = True
    np.testing.assert_array_equal(found, expected)


def test_each_ear_is_judged_alone(heard):
    found = late(delayed(heard, [7], 0.008, ears=1), *BOX)
    assert found[7].tolist() == [False, True]
    assert found.sum() == 1


SHORT = 0.0045
"""By so much may the correction fall short, m: it is to the nearest place that others heard, not to
the nearest of the body; of sixty heads few hear the same place."""


def test_the_space_is_nearly_as_if_none_had_been_late(heard):
    points = surface(2000)
    wrong = delayed(heard, [3, 20, 41], 0.012)
    assert wrong.clearance(points)[0].min() < -0.010
    right = corrected(wrong, *BOX)
    assert right.clearance(points)[0].min() > -SHORT
    np.testing.assert_array_equal(right.emitters, wrong.emitters)
    others = np.delete(np.arange(60), [3, 20, 41])
    np.testing.assert_array_equal(right.first[others], heard.first[others])
    # Left out, they would leave all that the others do not reach.
    alone = replace(wrong, first=wrong.first.copy())
    alone.first[[3, 20, 41]] = -np.inf
    around = 1.3 * surface(2000)
    assert (right.clearance(around)[0] < 0).sum() > (alone.clearance(around)[0] < 0).sum()


@pytest.mark.parametrize("by", [0.006, 0.008, 0.015])
def test_it_was_so_late_at_least(heard, by):
    found = lateness(delayed(heard, [7], by), *BOX)[7]
    assert (found <= by + late_echo.READING).all()
    assert (found > by - SHORT).all()


@pytest.mark.parametrize(("pose", "by"), [(7, 0.008), (6, 0.005), (24, 0.003)])
def test_one_that_heard_too_early_takes_nobody_along(heard, pose, by):
    """A click in front of the body: it is ruled out by several, none of whom is against others."""
    found = late(delayed(heard, [pose], -by), *BOX)
    assert not np.delete(found, pose, axis=0).any()


def test_less_than_the_reading_is_not_late(heard):
    generator = np.random.default_rng(0)
    noise = generator.uniform(-0.0005, 0.0005, heard.first.shape)
    assert not late(replace(heard, first=heard.first + noise), *BOX).any()


def test_who_heard_nothing_is_neither_late_nor_asked(heard):
    first = heard.first.copy()
    first[[5, 6]] = -np.inf
    found = late(delayed(replace(heard, first=first), [7], 0.008), *BOX)
    assert np.flatnonzero(found.any(axis=1)).tolist() == [7]
    silent = replace(heard, first=np.full_like(first, -np.inf))
    assert not late(silent, *BOX).any()


def test_a_beam_rules_out_nothing_beside_it(heard):
    """A late head that looks away speaks for no place of the body."""
    axes = heard.axes.copy()
    axes[7] *= -1
    away = replace(delayed(heard, [7], 0.008), axes=axes, within=0.8)
    assert not np.delete(late(away, *BOX), 7, axis=0).any()
    assert (corrected(away, *BOX).clearance(surface(500))[0] > -0.0005).all()


@pytest.mark.parametrize("most", [0, 1e6])
def test_with_more_echoes_than_can_be_looked_at_it_is_coarser_and_not_wrong(
    heard, monkeypatch, most
):
    looked_at = []

    class Counted(EchoHull):
        def behind(self, points):
            looked_at.append(len(points))
            return super().behind(points)

    wrong = delayed(heard, [7], 0.02)
    counted = Counted(wrong.emitters, wrong.receivers, wrong.first, wrong.axes)
    late(counted, *BOX)
    without_limit = sum(looked_at)
    looked_at.clear()
    monkeypatch.setattr(late_echo, "MOST", most)
    found = late(counted, *BOX)
    assert not np.delete(found, 7, axis=0).any()
    assert sum(looked_at) < without_limit / 4
