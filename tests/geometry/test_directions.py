# SPDX-License-Identifier: MIT
import math

import numpy as np
import pytest
from scipy.spatial import cKDTree

from sononerf.geometry.directions import CapSpiral, fibonacci_cap, fibonacci_sphere


def test_sphere_averages_are_those_of_the_sphere():
    directions = fibonacci_sphere(2000)
    np.testing.assert_allclose(np.linalg.norm(directions, axis=1), 1.0, atol=1e-12)
    # Mean of x is 0 and of x x^T is 1/3; a spiral of 2000 comes as near as about 1/2000.
    np.testing.assert_allclose(directions.mean(axis=0), 0.0, atol=5e-4)
    np.testing.assert_allclose(directions.T @ directions / 2000, np.eye(3) / 3, atol=5e-4)


@pytest.mark.parametrize("half_angle", [1e-3, 0.3, 2.5, math.pi])
def test_cap_has_equal_areas_up_to_its_rim(half_angle):
    axis = np.array([1.0, -2.0, 0.5])
    directions = fibonacci_cap(4001, axis=axis, half_angle=half_angle, offset=(0.5, 0.2))
    to_axis = np.linalg.norm(np.cross(directions, axis / np.linalg.norm(axis)), axis=1)
    angle = np.arctan2(to_axis, directions @ axis / np.linalg.norm(axis))
    assert angle.max() < half_angle
    # Half of the area of a cap lies within the angle of half its height.
    middle = 2.0 * math.asin(math.sin(half_angle / 2.0) / math.sqrt(2.0))
    assert (angle < middle).sum() in (2000, 2001)


def test_offset_shifts_and_turns_the_whole_pattern():
    plain = fibonacci_cap(50, axis=(0, 0, 1), half_angle=0.4, offset=(0.5, 0.0))
    turned = fibonacci_cap(50, axis=(0, 0, 1), half_angle=0.4, offset=(0.5, 0.25))
    shifted = fibonacci_cap(50, axis=(0, 0, 1), half_angle=0.4, offset=(0.9, 0.0))
    np.testing.assert_allclose(turned[:, 2], plain[:, 2], atol=1e-12)
    phase = np.arctan2(turned[:, 1], turned[:, 0]) - np.arctan2(plain[:, 1], plain[:, 0])
    np.testing.assert_allclose(np.mod(phase, 2 * np.pi), np.pi / 2, atol=1e-9)
    assert (shifted[:, 2] < plain[:, 2]).all()


def area(cells):
    """In shares times turns (N,)."""
    (a, b), (c, d) = cells.sides
    return np.abs(a * d - b * c)


@pytest.mark.parametrize("split", [2, 3])
def test_parts_tile_their_cell(split):
    cells = CapSpiral(3000, (1.0, 0.0, 0.0), 2.0, (0.3, 0.7)).cells(np.array([5, 700, 2900]))
    parts = cells.divided(split).divided(split)
    steps = split**2
    for cell in range(3):
        own = slice(cell * steps**2, (cell + 1) * steps**2)
        off = parts.middles[:, own] - cells.middles[:, cell, None]
        # In units of the cell's sides the parts' middles are a square lattice that fills it.
        inside = np.linalg.solve(cells.sides[:, :, cell].T, off)
        found = np.unique(np.round(inside * 2 * steps).astype(int), axis=1)
        np.testing.assert_allclose(inside * 2 * steps, np.round(inside * 2 * steps), atol=1e-6)
        odd = np.arange(1 - steps, steps, 2)
        expected = np.stack(np.meshgrid(odd, odd, indexing="ij")).reshape(2, -1)
        np.testing.assert_array_equal(found, expected)
        sides = parts.sides[:, :, own]
        np.testing.assert_allclose(sides, (cells.sides[:, :, [cell]] / steps).repeat(steps**2, 2))


def test_solid_angles_add_up_to_the_cap():
    spiral = CapSpiral(123, (1.0, 0.0, 0.0), 0.5, (0.5, 0.0))
    assert 123 * spiral.solid_angle == pytest.approx(2 * np.pi * (1 - math.cos(0.5)))


def test_neighbourhood_holds_the_nearest_four():
    spiral = CapSpiral(10_000, (0.0, 0.0, 1.0), 0.3, (0.5, 0.5))
    found = spiral.neighbourhood(np.array([5000]))
    directions = spiral.directions()
    nearest = cKDTree(directions).query(directions[5000], k=5)[1]
    assert set(nearest) == set(found)


def test_rotation_turns_the_pattern():
    turn = np.array([[0.0, -1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, 1.0]])
    plain = CapSpiral(20, (1.0, 0.5, 0.0), 0.5, (0.5, 0.1))
    turned = CapSpiral(20, (1.0, 0.5, 0.0), 0.5, (0.5, 0.1), turn)
    np.testing.assert_allclose(turned.directions(), plain.directions() @ turn.T, atol=1e-12)


@pytest.mark.parametrize(
    ("arguments", "match"),
    [
        ({"count": 0}, "count is 0"),
        ({"half_angle": 0.0}, "half_angle"),
        ({"half_angle": 3.2}, "half_angle"),
        ({"axis": (0.0, 0.0, 0.0)}, "axis"),
    ],
)
def test_faults_are_refused(arguments, match):
    good = {"count": 5, "axis": (0.0, 0.0, 1.0), "half_angle": 1.0, "offset": (0.5, 0.0)}
    with pytest.raises(ValueError, match=match):
        fibonacci_cap(**{**good, **arguments})


@pytest.mark.parametrize("half_angle", [0.05, 0.8, math.pi])
@pytest.mark.parametrize("offset", [(0.5, 0.0), (0.01, 0.99)])
def test_no_direction_within_a_cone_is_left_out(half_angle, offset):
    generator = np.random.default_rng(1)
    cap = CapSpiral(20_000, (1.0, 2.0, -0.5), half_angle, offset, random_rotation(generator))
    directions = cap.directions()
    for width in (1e-4, 0.03, 0.4):
        towards = directions[generator.integers(0, len(directions), 4)]
        index = cap.reaching(towards, np.full(4, width * half_angle))
        inside = (directions @ towards.T >= math.cos(width * half_angle)).any(axis=1)
        assert np.isin(np.flatnonzero(inside), index).all()
        np.testing.assert_array_equal(cap.directions(index), directions[index])
        if width < 0.1:
            assert len(index) < 0.1 * len(directions)
    assert len(cap.reaching(directions[:1], np.array([math.pi]))) == len(directions)


def random_rotation(generator):
    turned, _ = np.linalg.qr(generator.normal(size=(3, 3)))
    return turned
