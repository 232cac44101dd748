# SPDX-License-Identifier: MIT
import numpy as np
import pytest

from sononerf.geometry.directions import fibonacci_sphere
from sononerf.geometry.lattice import Lattice
from sononerf.surface.start.evidence_grids import planes, thinness, winding_of

SPACING, RADIUS = 0.002, 0.016
LATTICE = Lattice.over(np.full(3, -0.03), np.full(3, 0.03), SPACING)
NOTHING = np.zeros((0, 3)), np.zeros((0, 3)), np.zeros(0)


def sphere():
    normals = fibonacci_sphere(1500)
    return RADIUS * normals, normals, np.ones(len(normals))


def sides(thickness, outward=True):
    """Two flat sides that look away from each other, or at each other over a gap."""
    x, y = (a.ravel() for a in np.meshgrid(*[np.arange(-0.02, 0.0201, 0.001)] * 2))
    top = np.stack((x, y, np.full(len(x), thickness / 2)), axis=1)
    up = np.tile([0.0, 0.0, 1.0 if outward else -1.0], (len(x), 1))
    bottom = top * [1, 1, -1]
    return np.concatenate((top, bottom)), np.concatenate((up, -up)), np.ones(2 * len(x))


def value(grid, *place):
    return LATTICE.read(grid, np.array([place]))[0]


@pytest.mark.parametrize(
    ("thickness", "outward", "expected"),
    [(0.0005, True, 1.0), (0.002, True, 1.0), (0.016, True, 0.0), (0.004, False, 0.0)],
)
def test_only_what_has_its_other_side_close_behind_it_is_thin(thickness, outward, expected):
    thin = thinness(LATTICE, *sides(thickness, outward))
    assert value(thin, 0, 0, thickness / 2) == pytest.approx(expected, abs=0.1)
    assert ((thin >= 0) & (thin <= 1.0001)).all()


def test_a_sphere_is_not_thin():
    assert thinness(LATTICE, *sphere()).max() < 0.05


def test_near_a_sphere_the_distance_to_its_planes_is_known():
    known, target = planes(LATTICE, *sphere())
    distance = np.linalg.norm(LATTICE.points(), axis=1).reshape(LATTICE.shape) - RADIUS
    near = np.abs(distance) < SPACING
    assert known[near].min() > 0.5
    np.testing.assert_allclose(target[near], distance[near] / SPACING, atol=0.2)
    assert known[np.abs(distance) > 4 * SPACING].max() < 1e-3
    assert known.max() <= 1


def test_the_winding_number_tells_inside_from_outside_however_loud_the_places_are():
    points, normals, weight = sphere()
    loud = weight * np.where(points[:, 0] > 0, 1.0, 0.2)
    for some in (weight, loud):
        winding = winding_of(LATTICE, points, normals, some)
        assert value(winding, 0, 0, 0) == pytest.approx(1.0, abs=0.25)
        assert abs(value(winding, 0.026, 0, 0)) < 0.1


def test_a_gap_whose_walls_look_at_each_other_has_a_negative_winding_number():
    assert value(winding_of(LATTICE, *sides(0.012, outward=False)), 0, 0, 0) < -0.3
    assert value(winding_of(LATTICE, *sides(0.012)), 0, 0, 0) > 0.3


def test_without_points_nothing_is_known():
    assert not thinness(LATTICE, *NOTHING).any()
    known, target = planes(LATTICE, *NOTHING)
    assert not known.any()
    assert not target.any()
