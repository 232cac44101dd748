# SPDX-License-Identifier: MIT
import numpy as np

from sononerf.geometry.lattice import MARGIN, Lattice

LOWER, UPPER = np.array([-0.01, 0.0, 0.02]), np.array([0.01, 0.03, 0.03])


def test_a_lattice_covers_box_and_margin():
    lattice = Lattice.over(LOWER, UPPER, 0.002)
    assert lattice.shape == (11 + 2 * MARGIN, 16 + 2 * MARGIN, 6 + 2 * MARGIN)
    points = lattice.points()
    np.testing.assert_allclose(points.min(axis=0), LOWER - MARGIN * 0.002)
    np.testing.assert_allclose(points.max(axis=0), UPPER + MARGIN * 0.002)
    np.testing.assert_allclose(lattice.coordinates(points[:1]), [[0, 0, 0]], atol=1e-12)


def test_spreading_keeps_the_sum_and_the_middle():
    lattice = Lattice.over(LOWER, UPPER, 0.002)
    point = np.array([[0.0013, 0.0121, 0.0257]])
    for deviation in (0.0, 1.0):
        grid = lattice.spread(point, np.array([2.0]), deviation)
        assert abs(grid.sum() - 2.0) < 1e-4
        middle = (grid.ravel() / grid.sum()) @ lattice.points()
        np.testing.assert_allclose(middle, point[0], atol=2e-5)


def test_points_outside_are_left_out():
    lattice = Lattice.over(LOWER, UPPER, 0.002)
    assert lattice.spread(np.array([[1.0, 0, 0]]), np.ones(1)).sum() == 0


def test_reading_is_linear():
    lattice = Lattice.over(LOWER, UPPER, 0.002)
    plane = (lattice.points() @ [1.0, -2.0, 3.0]).reshape(lattice.shape)
    point = np.array([[0.0013, 0.0121, 0.0257]])
    np.testing.assert_allclose(lattice.read(plane, point), point @ [1.0, -2.0, 3.0], atol=1e-9)
