# SPDX-License-Identifier: MIT


import dataclasses
from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial.distance import cdist

from sononerf.echoes.free_space import EchoHull, weighted
from sononerf.geometry.directions import fibonacci_sphere
from sononerf.geometry.meshes import Plane

AHEAD = np.array([1.0, 0.0, 0.0])


def hull_of(emitters, receivers, first, axes=None, **options):
    count = len(emitters)
    given = (emitters, receivers, np.reshape(first, (count, -1)))
    given = [np.asarray(each, dtype=np.float64) for each in given]
    axes = np.tile(AHEAD, (count, 1)) if axes is None else np.asarray(axes, dtype=np.float64)
    return EchoHull(*given, axes, **options)


def by_chance(count=12, **options):
    """Heads around a metre away, emitter and two ears some centimetres apart."""
    generator = np.random.default_rng(0)
    middles = fibonacci_sphere(count)
    return hull_of(
        middles + generator.normal(scale=0.03, size=(count, 3)),
        middles[:, None] + generator.normal(scale=0.03, size=(count, 2, 3)),
        generator.uniform(0.6, 0.9, size=(count, 2)),
        -middles,
        **options,
    )


def points_around(count, size=0.3):
    return np.random.default_rng(1).uniform(-size, size, (count, 3))


def test_half_of_the_way_out_and_back_less_the_first_echo():
    """A slow loop: the pose and the ear that leave a place least count."""
    hull = by_chance()
    points = points_around(40)
    found, pose = hull.clearance(points)
    for place, value, least in zip(points, found, pose, strict=True):
        left = [
            min(
                (np.linalg.norm(place - emitter) + np.linalg.norm(place - ear)) / 2 - range_
                for ear, range_ in zip(ears, first, strict=True)
            )
            for emitter, ears, first in zip(hull.emitters, hull.receivers, hull.first, strict=True)
        ]
        assert value == pytest.approx(min(left), abs=1e-12)
        assert least == np.argmin(left)
    assert (found < 0).any()
    assert (found > 0).any()


def test_the_places_of_one_first_echo_are_an_ellipsoid_around_emitter_and_ear():
    """Half axis a along the line of both, b = sqrt(a² - c²) across it, c half of their distance."""
    a, c = 0.4, 0.05
    b = np.sqrt(a**2 - c**2)
    hull = hull_of([[-c, 0, 0]], [[[c, 0, 0]]], [a])
    ends = np.array([[a, 0, 0], [-a, 0, 0], [0, b, 0], [0, -b, 0], [0, 0, b], [0, 0, -b]])
    np.testing.assert_allclose(hull.clearance(ends)[0], 0.0, atol=1e-15)
    angle = np.linspace(0, np.pi, 9)
    around = np.stack((a * np.cos(angle), b * np.sin(angle), 0 * angle), axis=1)
    np.testing.assert_allclose(hull.clearance(around)[0], 0.0, atol=1e-15)
    # Along the long axis a step counts whole; across it, as far as the way to the foci grows.
    beyond = [[a + 0.01, 0, 0], [0, b + 0.01, 0], [a - 0.01, 0, 0]]
    expected = [0.01, np.hypot(b + 0.01, c) - a, -0.01]
    np.testing.assert_allclose(hull.clearance(beyond)[0], expected, atol=1e-15)
    # A sphere around half way between them would be 3 mm off at the end of the short axis.
    assert a - b > 0.003


def test_of_two_ears_that_heard_apart_the_nearer_bound_counts():
    """An ear 20 mm off to the side, and one that heard its first echo 5 mm earlier."""
    place = np.array([[0.3, 0.0, 0.0]])
    ears = np.array([[[0.0, 0.02, 0.0], [0.0, -0.02, 0.0]]])
    way = (0.3 + np.hypot(0.3, 0.02)) / 2
    late = hull_of([[0.0] * 3], ears, [[way, way - 0.005]])
    assert late.clearance(place)[0] == pytest.approx(0.0, abs=1e-15)
    assert hull_of([[0.0] * 3], ears[:, ::-1], late.first).clearance(place)[0] == pytest.approx(0)
    # To the side of the ear that heard late there is less left than to the other side.
    sides = [[0.3, 0.05, 0.0], [0.3, -0.05, 0.0]]
    one, two = late.clearance(sides)[0]
    assert one < two
    assert hull_of([[0.0] * 3], ears, [[way, way]]).clearance(sides)[0] == pytest.approx(one)


def test_an_ear_that_heard_nothing_says_nothing():
    ears = np.array([[[0.0, 0.02, 0.0], [0.0, -0.02, 0.0]]] * 2)
    emitters = np.array([[0.0] * 3, [-0.1, 0.0, 0.0]])
    place = [[0.5, 0.0, 0.0]]
    half = hull_of(emitters[:1], ears[:1], [[-np.inf, 0.3]])
    only = hull_of(emitters[:1], ears[:1, 1:], [[0.3]])
    np.testing.assert_array_equal(half.clearance(place)[0], only.clearance(place)[0])
    deaf = hull_of(emitters[:1], ears[:1], [[-np.inf, -np.inf]])
    assert deaf.clearance(place)[0] == np.inf
    found, pose = hull_of(emitters, ears, [[-np.inf] * 2, [0.45, 0.45]]).clearance(place)
    assert pose == [1]
    assert np.isfinite(found)


def test_a_pose_speaks_only_for_what_lies_ahead_of_it():
    """The angle is that at the emitter, to the head's own axis."""
    limit = np.radians(30)
    axis = np.array([0.6, 0.0, 0.8])
    emitter = np.array([0.1, -0.2, 0.3])
    ears = emitter + np.array([[[0.01, 0.0, 0.0]]])
    aside = np.array([0.8, 0.0, -0.6])
    places = emitter + 0.2 * np.array(
        [np.cos(angle) * axis + np.sin(angle) * aside for angle in limit + np.array([-1e-6, 1e-6])]
    )
    hull = hull_of([emitter], ears, [0.5], [axis], within=np.cos(limit))
    found, _ = hull.clearance(places)
    everywhere = hull_of([emitter], ears, [0.5], [axis]).clearance(places)[0]
    assert found.tolist() == [everywhere[0], np.inf]
    assert (everywhere < -0.25).all()
    # Without a limit, what lies behind the head counts, too.
    behind = [emitter - 0.2 * axis]
    assert hull_of([emitter], ears, [0.5], [axis]).clearance(behind)[0] < -0.25
    assert hull.clearance(behind)[0] == np.inf
    # Another pose that looks there still says so.
    pair = hull_of([emitter] * 2, [ears[0]] * 2, [0.5, 0.3], [axis, aside], within=np.cos(limit))
    assert pair.clearance([emitter + 0.2 * aside])[1] == [1]


def test_the_clearance_changes_no_faster_than_the_place():
    """Both ways of an echo change by no more than a step, so half of their sum does, too."""
    hull = by_chance()
    points, generator = points_around(500, 0.5), np.random.default_rng(2)
    steps = generator.normal(size=(500, 3)) * 10 ** generator.uniform(-4, -1, (500, 1))
    change = np.abs(hull.clearance(points + steps)[0] - hull.clearance(points)[0])
    length = np.linalg.norm(steps, axis=1)
    assert (change <= length + 1e-12).all()
    assert (change > 0.5 * length).any()


def surface_of_a_box(half, spacing):
    """Points over the six faces of a box around the origin."""
    points = []
    for axis in range(3):
        one, two = ((axis + 1) % 3, (axis + 2) % 3)
        sides = [
            np.linspace(-half[a], half[a], round(2 * half[a] / spacing) + 1) for a in (one, two)
        ]
        for sign in (-1, 1):
            face = np.zeros((len(sides[0]), len(sides[1]), 3))
            face[..., axis] = sign * half[axis]
            face[..., one], face[..., two] = sides[0][:, None], sides[1]
            points.append(face.reshape(-1, 3))
    return np.concatenate(points)


def test_a_convex_body_heard_from_all_around_is_left_as_it_is():
    """A box, whose flat faces answer next to no pose: edges and corners answer the others."""
    half = np.array([0.02, 0.015, 0.01])
    body = surface_of_a_box(half, 0.0025)
    heads = 0.4 * fibonacci_sphere(2000)
    emitters = heads + np.array([0.0, 0.0, 0.004])
    receivers = heads[:, None] + np.array([[0.0, 0.01, 0.0], [0.0, -0.01, 0.0]])
    out = cdist(emitters, body)
    first = [((out + cdist(receivers[:, e], body)) / 2).min(axis=1) for e in (0, 1)]
    hull = hull_of(emitters, receivers, np.stack(first, axis=1), -heads / 0.4)
    on = hull.clearance(body)[0]
    # Nothing of the body is lost. Heads lie 32 mm apart, so no place of a face is farther than
    # 22 mm from the foot of one; there its sphere of 0.38 m or more has risen by 22² / 760 mm.
    assert on.min() > -1e-12
    assert on.max() < 0.022**2 / (2 * 0.38)
    outside = body * (1 + 0.002 / half.min())  # at least 2 mm beyond, less those 0.64 mm
    assert hull.clearance(outside)[0].max() < -0.0012
    inside = 0.9 * body
    assert (hull.clearance(inside)[0] > 0.0005).all()


def test_a_pose_hears_from_half_way_between_emitter_and_ears():
    hull = hull_of(
        [[0.004, 0.0, -0.01], [1.0, 2.0, 3.0]],
        [[[-0.01, 0.01, 0.005], [-0.01, -0.004, 0.005]], [[2.0, 2.0, 3.0], [4.0, 2.0, 3.0]]],
        [[0.3, 0.3], [0.3, 0.3]],
    )
    # The first head's ears have their middle at (-10, 3, 5) mm.
    expected = [[-0.003, 0.0015, -0.0025], [2.0, 2.0, 3.0]]
    np.testing.assert_allclose(hull.sources, expected, rtol=0, atol=1e-15)


def test_an_outlier_tells_nothing():
    hull = by_chance()
    points = points_around(200)
    weight = np.ones_like(hull.first)
    weight[3] = 0.0
    found, pose = dataclasses.replace(hull, weight=weight).clearance(points)
    assert not (pose == 3).any()
    others = np.delete(np.arange(12), 3)
    alone = EchoHull(
        *(each[others] for each in (hull.emitters, hull.receivers, hull.first)), -AHEAD
    )
    np.testing.assert_allclose(found, alone.clearance(points)[0])
    assert (hull.clearance(points)[1] == 3).any()


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


def test_a_tip_that_a_quarter_of_the_poses_miss_is_kept():
    """A ball with a faint tip: those that miss it hear the ball behind it."""
    poses, tip, radius = 0.4 * fibonacci_sphere(200), np.array([0.0, 0.0, 0.06]), 0.02
    ball = np.linalg.norm(poses, axis=1) - radius
    ahead = np.linalg.norm(poses - tip, axis=1)
    hears = ahead < ball
    missing = hears & (np.arange(200) % 4 == 0)
    assert missing.sum() > 0.05 * 200  # more than are taken for undetected
    first = np.where(hears & ~missing, ahead, ball)
    hull = hull_of(poses, poses[:, None], first, -poses / 0.4)
    found = weighted(hull, RESOLUTION)
    np.testing.assert_array_equal(found.weight[:, 0] == 0.0, missing)
    assert found.clearance([tip])[0] > -0.2 * RESOLUTION


def test_nothing_is_below_a_support():
    plane = Plane.through(np.array([0.0, 0.0, -0.01]), AHEAD[[2, 1, 0]])
    far = hull_of([[0.5, 0.0, 0.5]], [[[0.5, 0.0, 0.5]]], [0.1])
    found = dataclasses.replace(far, plane=plane)
    points = np.array([[0.0, 0.0, -0.03], [0.0, 0.0, 0.02]])
    np.testing.assert_allclose(found.clearance(points)[0], [-0.02, 0.03], atol=1e-12)
    assert (far.clearance(points)[0] > 0.03).all()
