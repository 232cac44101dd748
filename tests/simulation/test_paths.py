# SPDX-License-Identifier: MIT
import math

import numpy as np
import pytest
import trimesh

from sononerf.geometry.directions import CapSpiral, fibonacci_cap
from sononerf.geometry.raycast import RayCaster
from sononerf.simulation.paths import SPLIT, aim, echo_paths, trace
from tests.simulation.listening import ball, box, wall

PARTS = SPLIT**2
ORIGIN = np.zeros(3)


def corner():
    """Two plates that meet at right angles along z: x = 1 and y = 1."""
    one, two = trimesh.creation.box((0.1, 4, 4)), trimesh.creation.box((4, 0.1, 4))
    one.apply_translation([1.05, 0, 0])
    two.apply_translation([0, 1.05, 0])
    return RayCaster(trimesh.util.concatenate([one, two]))


def bounces(caster, directions, count, emitter=ORIGIN, solid_angle=1.0):
    return list(trace(caster, emitter, np.asarray(directions), count, solid_angle=solid_angle))


def about_x(count, half_angle, offset=(0.5, 0.0)):
    return fibonacci_cap(count, axis=(1, 0, 0), half_angle=half_angle, offset=offset)


def detour(bounce, listener):
    """Detour, spread and stiffness (H,) towards a place."""
    away = listener - bounce.points
    distance = np.linalg.norm(away, axis=1)
    ways = bounce.paths_to(listener)
    np.testing.assert_allclose(ways.distance, distance)
    for found, axis in ((ways.rise, bounce.flat), (ways.cosine, bounce.mirrored)):
        np.testing.assert_allclose(found, np.einsum("nd,nd->n", away, axis) / distance, atol=1e-6)
    return [values.astype(float) for values in (ways.detour, ways.spread, ways.stiffness)]


def shift(bounce):
    """How the hits move (2, H, 3)."""
    return bounce.footprint.shift.transpose(0, 2, 1).astype(float)


def all_alike(bounce):
    """Every hit is heard, and none is in doubt."""
    return np.ones(len(bounce.ray), dtype=bool), np.zeros(len(bounce.ray))


def doubtful(share, number=1):
    """Every hit is heard; the hits of ``share`` of the directions are in doubt for ever."""

    def judge(bounce):
        heard, doubt = all_alike(bounce)
        if bounce.number == number:
            doubt = np.where(bounce.emitted[:, 1] > share, 1.0 + bounce.emitted[:, 1], 0.0)
        return heard, doubt

    return judge


def sides(directions):
    """Two unit vectors (2, N, 3) square to each direction."""
    first = np.cross(directions, np.eye(3)[np.abs(directions).argmin(axis=1)])
    first /= np.linalg.norm(first, axis=1, keepdims=True)
    return np.stack([first, np.cross(directions, first)])


def turned(directions, by):
    moved = directions + by
    return moved / np.linalg.norm(moved, axis=1, keepdims=True)


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
    way = second.points - first.points
    np.testing.assert_allclose(way / np.linalg.norm(way), first.mirrored, atol=1e-4)
    # Unfolded, the path runs straight on to the mirrored second plate at y = 1.
    assert second.length[0] == pytest.approx(1 / math.sin(0.6), abs=1e-5)
    assert (first.number, second.number) == (1, 2)
    assert (first.triangles.shape, second.triangles.shape) == ((1, 1), (1, 2))
    np.testing.assert_array_equal(second.triangles[:, 0], first.triangles[:, 0])


def test_a_plate_is_the_same_from_both_sides():
    plate = trimesh.Trimesh([[1, -1, -1], [1, 1, -1], [1, 0, 2]], [[0, 1, 2]])
    for mesh in (plate, trimesh.Trimesh(plate.vertices, plate.faces[:, ::-1])):
        ray = np.array([[1.0, 0.0, 0.0]])
        (bounce,) = trace(RayCaster(mesh), np.zeros(3), ray, 3, solid_angle=1.0)
        np.testing.assert_allclose(bounce.flat, [[-1, 0, 0]], atol=1e-12)
        np.testing.assert_allclose(bounce.mirrored, [[-1, 0, 0]], atol=1e-12)


def test_differentials_are_the_moves_of_neighbouring_rays_over_three_bounces():
    """Two balls and a wall; against rays that start a little to either side."""
    mesh = [
        ball(0.05, (0.3, 0, 0)),
        ball(0.05, (0.2, 0.18, 0)),
        wall(-0.1, (-0.5,) * 2, (0.5,) * 2),
    ]
    caster = RayCaster(trimesh.util.concatenate(mesh))
    directions, step = about_x(4000, 0.16), 5e-5
    plain = bounces(caster, directions, 3)
    first = plain[0]
    # The library's turns: the first hit's shift, square to the ray, over its length.
    along = np.einsum("knd,nd->kn", shift(first), first.emitted)
    turns = np.full((2, *directions.shape), np.nan)
    turns[:, first.ray] = shift(first) - along[..., None] * first.emitted
    turns[:, first.ray] /= first.length[:, None]
    assert len(plain) == 3
    for side in sides(directions):
        less, more = (bounces(caster, turned(directions, by * side), 3) for by in (-step, step))
        for number, (here, before, behind) in enumerate(zip(plain, less, more, strict=True)):
            # Those of which all three hit the same triangles, one after the other.
            hits = [
                dict(zip(b.ray, range(len(b.ray)), strict=True)) for b in (here, before, behind)
            ]
            rows = np.array(
                [[h[ray] for h in hits] for ray in here.ray if all(ray in h for h in hits)]
            )
            found = [b.triangles[rows[:, k]] for k, b in enumerate((here, before, behind))]
            same = (found[0] == found[1]).all(axis=1) & (found[0] == found[2]).all(axis=1)
            one, two, three = rows[same].T
            assert len(one) > 0.3 * len(here.ray)
            slope = (behind.points[three] - before.points[two]) / (2 * step)
            share = np.einsum("knd,nd->kn", turns, side)[:, here.ray[one]]
            expected = np.einsum("kn,knd->nd", share, shift(here)[:, one])
            error = np.linalg.norm(slope - expected, axis=1) / np.linalg.norm(slope, axis=1)
            # Normals are known to 6e-8, which over the step is 1e-3, and balls enlarge it.
            assert np.percentile(error, 95) < (1e-4, 5e-3, 1e-2)[number]


def test_a_mirror_keeps_the_cross_section_of_the_straight_way():
    caster = RayCaster(box((-0.2, -0.15, -0.1), (0.3, 0.25, 0.2)))
    cap = CapSpiral(500, (1.0, 0.0, 0.0), math.pi, (0.5, 0.2))
    found = bounces(caster, cap.directions(), 10)
    for bounce in found:
        # Unfolded it is one sphere about the emitter.
        np.testing.assert_allclose(bounce.footprint.tube, bounce.length**2, rtol=1e-5)


@pytest.mark.parametrize("radius", [0.01, 0.05])
def test_a_convex_mirror_widens_a_bundle_as_geometrical_acoustics_says(radius):
    r"""Coddington's equations: after a mirror of radius a, met at an angle of incidence t,

    the bundle is d1 + d2 + 2 d1 d2 / (a cos t) wide in the plane of incidence and
    d1 + d2 + 2 d1 d2 cos t / a square to it. (M. Born and E. Wolf, Principles of Optics, 4.6.)
    """
    mesh = [ball(radius, (0.3, 0, 0)), box((-0.5,) * 3, (1.0, 0.5, 0.5))]
    caster = RayCaster(trimesh.util.concatenate(mesh))
    directions = about_x(2000, 0.9 * math.asin(radius / 0.3))
    first, second = bounces(caster, directions, 2)
    np.testing.assert_array_equal(first.ray, second.ray)
    d1, d2 = first.length, second.length - first.length
    normal = (first.points - [0.3, 0, 0]) / radius
    cosine = -np.einsum("nd,nd->n", normal, first.emitted)
    expected = (d1 + d2 + 2 * d1 * d2 / (radius * cosine)) * (
        d1 + d2 + 2 * d1 * d2 * cosine / radius
    )
    # Flat facets of 2 degrees under smooth normals: some 2 degrees / tan of the grazing angle.
    error = second.footprint.tube / expected - 1
    assert np.abs(error).max() < 0.06
    assert np.sqrt(np.mean(error**2)) < 0.02


def test_the_detour_is_how_much_longer_the_path_is_than_the_mirrors():
    """A plate and a ball, heard at the emitter and aside; to second order about the glint."""
    listener = np.array([0.02, 0.05, -0.03])
    for mesh, image in ((wall(0.3, (-1, -1), (1, 1)), None), (ball(0.05, (0.3, 0, 0), 6), 0.05)):
        caster = RayCaster(mesh)
        (wide,) = bounces(caster, about_x(200_000, 0.16), 1)
        distance = np.linalg.norm(wide.points - listener, axis=1)
        shortest = (wide.length + distance).min()
        if image is None:
            shortest = np.linalg.norm(listener - [0.6, 0, 0])
        best = (wide.length + distance).argmin()
        near = np.flatnonzero(np.linalg.norm(wide.points - wide.points[best], axis=1) < 0.008)
        found = detour(wide[near], listener)[0]
        exact = (wide.length + distance)[near] - shortest
        clear = exact > 0.1 * exact.max()
        # 8 mm off the glint third-order terms are 8 / 50 of the second-order ones for the ball.
        np.testing.assert_allclose(found[clear], exact[clear], rtol=0.06)
        assert found.min() >= 0.0
        assert found[np.flatnonzero(near == best)[0]] < 0.001 * exact.max()


@pytest.mark.parametrize("angle", [0.0, 0.01, 0.1])
@pytest.mark.parametrize("radius", [None, 0.1])
def test_the_spread_is_that_of_the_path_over_a_square_cell(radius, angle):
    """A plate at 0.3 m, and a ball in front of it; sampled on the round ball."""
    mesh = wall(0.3, (-1, -1), (1, 1)) if radius is None else ball(radius, (0.4, 0, 0), 6)
    side = 5e-3
    middle = np.array([[math.cos(angle), math.sin(angle), 0.0]])
    (bounce,) = bounces(RayCaster(mesh), middle, 1, solid_angle=side**2)
    (spread,) = detour(bounce, ORIGIN)[1]
    across = np.array([-math.sin(angle), math.cos(angle), 0.0])
    steps = side * ((np.arange(64) + 0.5) / 64 - 0.5)
    one, two = (step.ravel() for step in np.meshgrid(steps, steps))
    directions = middle + one[:, None] * across + two[:, None] * np.array([0.0, 0.0, 1.0])
    directions /= np.linalg.norm(directions, axis=1, keepdims=True)
    x = directions[:, 0]
    if radius is None:
        length = 0.3 / x
    else:
        length = 0.4 * x - np.sqrt(0.4**2 * (x**2 - 1) + radius**2)
    # Third order over the cell, and a facet of half a degree.
    assert spread == pytest.approx(np.std(2 * length), rel=0.02)


def test_no_ray_and_no_solid_angle_is_lost_in_a_closed_box():
    caster = RayCaster(box((-0.2, -0.15, -0.1), (0.3, 0.25, 0.2)))
    cap = CapSpiral(3000, (1.0, 0.0, 0.0), math.pi, (0.5, 0.2))
    for extra in (0, 6000):
        found = echo_paths(
            caster,
            ORIGIN,
            cap,
            bounces=10,
            extra=extra,
            judge=doubtful(0.3, 2) if extra else all_alike,
        )
        angle = np.zeros(11)
        for bounce in found:
            angle[bounce.number] += len(bounce.ray) * bounce.solid_angle
            assert bounce.number > 1  # the first is summed over points of the surface
            np.testing.assert_allclose(bounce.footprint.tube, bounce.length**2, rtol=1e-5)
        np.testing.assert_allclose(angle[2:], 4 * math.pi, rtol=1e-12)


@pytest.mark.parametrize("half_angle", [0.1, 0.8])
def test_refinement_loses_no_solid_angle(half_angle):
    """A wall fills the cap, another one stands behind; y > 0.02 is refined to the last ray."""
    cap = CapSpiral(2000, (1.0, 0.0, 0.0), half_angle, (0.5, 0.5))
    both = trimesh.util.concatenate([wall(0.3, (-2, -2), (2, 2)), wall(-0.3, (-9, -9), (9, 9))])
    path = {"bounces": 2, "extra": 20_000, "judge": doubtful(0.02, 2)}
    found = list(echo_paths(RayCaster(both), ORIGIN, cap, **path))
    total = sum(len(bounce.ray) * bounce.solid_angle for bounce in found)
    # Parts of cells at the rim may stand over it; as many parts are missed as were added.
    assert total == pytest.approx(2 * math.pi * (1 - math.cos(half_angle)), rel=1e-9)
    assert len(found) > 2
    sizes = [bounce.solid_angle for bounce in found]
    np.testing.assert_allclose(sizes, [sizes[0] / PARTS**level for level in range(len(sizes))])
    centre = sum(
        bounce.solid_angle * bounce.emitted.sum(axis=0) for bounce in found
    )  # of a cap: half its base's area along the axis
    np.testing.assert_allclose(
        centre, [math.pi * math.sin(half_angle) ** 2, 0, 0], atol=2e-3 * total
    )


def test_later_hits_come_from_divided_rays_and_lose_no_solid_angle():
    cap = CapSpiral(4000, (1.0, 1.0, 0.0), 0.5, (0.5, 0.0))
    plain = bounces(corner(), cap.directions(), 3, solid_angle=cap.solid_angle)
    covered, count = np.zeros(3), np.zeros(3, dtype=int)
    for path in echo_paths(corner(), ORIGIN, cap, bounces=3, extra=40_000, judge=all_alike):
        covered[path.number] += len(path.ray) * path.solid_angle
        count[path.number] += len(path.ray)
    expected = [len(bounce.ray) * bounce.solid_angle for bounce in plain]
    assert len(plain) == 2
    np.testing.assert_allclose(covered[2], expected[1], rtol=0.01)
    # Whoever hits twice is divided, with his neighbours, though nothing is in doubt.
    assert count[2] >= 4 * len(plain[1].ray)
