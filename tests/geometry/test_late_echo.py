# SPDX-License-Identifier: MIT
from dataclasses import replace

import numpy as np
import pytest

from sononerf.geometry import late_echo
from sononerf.geometry.directions import fibonacci_sphere
from sononerf.geometry.hull import EchoHull
from sononerf.geometry.late_echo import late, without_late

AWAY = 0.4
LENGTHS = np.array([0.04, 0.025, 0.003])
"""Half axes of a flat body, m."""
BOX = np.array([[-0.06, -0.05, -0.03], [0.06, 0.05, 0.03]])


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
    np.testing.assert_array_equal(without_late(heard, *BOX).first, heard.first)


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


def test_the_space_is_what_the_others_leave(heard):
    """The body's points, cut off by the late ones, are left again."""
    points = surface(2000)
    wrong = delayed(heard, [3, 20, 41], 0.008)
    assert (wrong.clearance(points)[0] < -0.004).any()
    right = without_late(wrong, *BOX)
    assert right.clearance(points)[0].min() > -0.0005
    np.testing.assert_array_equal(right.emitters, wrong.emitters)
    assert np.isneginf(right.first[[3, 20, 41]]).all()
    assert np.isfinite(np.delete(right.first, [3, 20, 41], axis=0)).all()


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
    assert (without_late(away, *BOX).clearance(surface(500))[0] > -0.0005).all()


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
