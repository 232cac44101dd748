# SPDX-License-Identifier: MIT
import math

import numpy as np
import pytest
import trimesh

from sononerf.geometry.directions import CapSpiral
from sononerf.geometry.raycast import RayCaster
from sononerf.simulation.paths import aim, echo_paths, trace


def corner():
    """Two plates that meet at right angles along z: x = 1 and y = 1."""
    one, two = trimesh.creation.box((0.1, 4, 4)), trimesh.creation.box((4, 0.1, 4))
    one.apply_translation([1.05, 0, 0])
    two.apply_translation([0, 1.05, 0])
    return RayCaster(trimesh.util.concatenate([one, two]))


def test_aim_sees_the_ball_from_outside_and_all_from_inside():
    axis, half_angle = aim(np.array([2.0, 0, 0]), np.zeros(3), 1.0)
    np.testing.assert_allclose(axis, [-2, 0, 0])
    assert half_angle == pytest.approx(math.radians(30))
    assert aim(np.array([0.5, 0, 0]), np.zeros(3), 1.0)[1] == math.pi


def test_a_ray_into_a_corner_comes_back_after_two_bounces():
    direction = np.array([[math.cos(0.6), math.sin(0.6), 0.0]])
    first, second = trace(corner(), np.zeros(3), direction, 5, solid_angle=1.0)
    np.testing.assert_allclose(first.points, [[1.0, math.tan(0.6), 0.0]], atol=1e-12)
    assert first.length[0] == pytest.approx(1 / math.cos(0.6))
    np.testing.assert_allclose(second.mirrored, -direction, atol=1e-12)
    np.testing.assert_allclose(second.emitted, direction)
    # Unfolded, the path runs straight on to the mirrored second plate at y = 1.
    assert second.length[0] == pytest.approx(1 / math.sin(0.6), abs=1e-5)
    assert (first.number, second.number) == (1, 2)


def test_a_plate_is_the_same_from_both_sides():
    plate = trimesh.Trimesh([[1, -1, -1], [1, 1, -1], [1, 0, 2]], [[0, 1, 2]])
    for mesh in (plate, trimesh.Trimesh(plate.vertices, plate.faces[:, ::-1])):
        ray = np.array([[1.0, 0.0, 0.0]])
        (bounce,) = trace(RayCaster(mesh), np.zeros(3), ray, 3, solid_angle=1.0)
        np.testing.assert_allclose(bounce.flat, [[-1, 0, 0]], atol=1e-12)
        np.testing.assert_allclose(bounce.mirrored, [[-1, 0, 0]], atol=1e-12)


def test_later_hits_come_from_divided_rays_and_lose_no_solid_angle():
    cap = CapSpiral(4000, (1.0, 1.0, 0.0), 0.5, (0.5, 0.0))
    plain = list(trace(corner(), np.zeros(3), cap.directions(), 3, solid_angle=cap.solid_angle))
    paths = list(echo_paths(corner(), np.zeros(3), cap, bounces=3, extra=40_000))
    np.testing.assert_array_equal(paths[0].points, plain[0].points)
    assert [path.number for path in paths] == [path.number for path in plain] == [1, 2]
    assert 4 * len(plain[1].ray) < len(paths[1].ray) <= 40_000
    covered = [len(path.ray) * path.solid_angle for path in (plain[1], paths[1])]
    assert covered[1] == pytest.approx(covered[0], rel=0.01)


def test_one_bounce_is_one_bounce():
    cap = CapSpiral(400, (1.0, 1.0, 0.0), 0.5, (0.5, 0.0))
    assert len(list(echo_paths(corner(), np.zeros(3), cap, bounces=1, extra=0))) == 1
    away = CapSpiral(400, (-1.0, -1.0, 0.0), 0.1, (0.5, 0.0))
    assert not list(echo_paths(corner(), np.zeros(3), away, bounces=3, extra=100))
