# SPDX-License-Identifier: MIT
import numpy as np
import pytest
from scipy.special import ellipe
from sononerf_scenes.bodies import EDGE, SIDE, ball, placed, tube

from sononerf.geometry.meshes import surface_faults

RADIUS = 0.008


def angles(start, end):
    return np.radians(np.linspace(start, end, 200))


@pytest.mark.parametrize("radius", [0.001, 0.01, 0.02, 0.05])
def test_a_ball_is_round_and_fine(radius):
    centre = np.array([0.1, -0.2, 0.3])
    body = ball(centre, radius)
    np.testing.assert_allclose(np.linalg.norm(body.vertices - centre, axis=1), radius, rtol=1e-9)
    assert body.edges_unique_length.max() <= EDGE
    assert surface_faults(body) == []


def test_a_straight_tube_is_a_capsule_along_its_path():
    body = tube([(0.0, 0.0), (0.03, 0.04)], RADIUS)
    assert surface_faults(body) == []
    assert body.edges_unique_length.max() <= EDGE
    along = np.array([0.0, 0.6, 0.8])
    at = np.clip(body.vertices @ along, 0.0, 0.05)
    # Every vertex is a radius away from the path, the round ends' too.
    np.testing.assert_allclose(
        np.linalg.norm(body.vertices - at[:, None] * along, axis=1), RADIUS, rtol=1e-9
    )
    np.testing.assert_allclose(body.extents, [0.016, 0.046, 0.056], rtol=2e-3)


def test_a_closed_tube_has_the_volume_of_its_section_times_its_length():
    wide, high = 0.02, 0.03
    around = angles(0, 360)
    body = tube(np.stack([wide * np.cos(around), high * np.sin(around)], axis=1), RADIUS)
    assert surface_faults(body) == []
    assert body.euler_number == 0  # it has a hole
    length = 4.0 * high * ellipe(1.0 - (wide / high) ** 2)
    # A polygon of sides s has (s/r)^2 / 6 less area than its circle, less again along the bend.
    exact = np.pi * RADIUS**2 * length
    assert 1.0 - (SIDE / RADIUS) ** 2 / 3.0 < body.volume / exact < 1.0


def test_a_tube_stays_fine_on_the_outside_of_a_bend():
    around = angles(0, 180)
    body = tube(np.stack([0.02 * np.cos(around), 0.02 * np.sin(around)], axis=1), RADIUS)
    assert body.edges_unique_length.max() <= 1.1 * EDGE


def test_what_is_placed_is_turned_as_a_head_and_centred():
    upright = tube([(0.0, 0.0), (0.0, 0.05)], RADIUS)
    pitched = placed(upright, pitch=90.0)
    np.testing.assert_allclose(pitched.bounds.mean(axis=0), 0.0, atol=1e-9)
    np.testing.assert_allclose(pitched.extents, [0.066, 0.016, 0.016], rtol=2e-3)
    # Roll comes first: what stood upright lies along y, and yaw turns that towards -x.
    rolled = placed(upright, yaw=30.0, roll=-90.0)
    tip = max(rolled.vertices, key=lambda vertex: vertex @ [-0.5, np.sqrt(0.75), 0.0])
    np.testing.assert_allclose(tip, [-0.5 * 0.033, np.sqrt(0.75) * 0.033, 0.0], atol=1e-5)
    np.testing.assert_allclose(upright.bounds[:, 2], [-RADIUS, 0.05 + RADIUS])  # as it was
