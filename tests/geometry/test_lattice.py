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


def test_reading_is_linear():
    lattice = Lattice.over(LOWER, UPPER, 0.002)
    plane = (lattice.points() @ [1.0, -2.0, 3.0]).reshape(lattice.shape)
    point = np.array([[0.0013, 0.0121, 0.0257]])
    np.testing.assert_allclose(lattice.read(plane, point), point @ [1.0, -2.0, 3.0], atol=1e-9)
