# SPDX-License-Identifier: MIT
import numpy as np

from sononerf.echoes.free_space import EchoHull
from sononerf.geometry.lattice import Lattice
from sononerf.surface.start.occupancy import clearance_grid


def test_the_clearance_is_exact_near_the_surface_and_has_the_right_sign_elsewhere():
    sources = np.array([[0.3, 0, 0], [-0.3, 0, 0], [0, 0.3, 0], [0, 0, 0.3]])
    first = np.full((4, 1), 0.28)
    hull = EchoHull(sources, sources[:, None], first, -sources / 0.3)
    lattice = Lattice.over(np.full(3, -0.03), np.full(3, 0.03), 0.002)
    found = clearance_grid(hull, lattice).ravel()
    exact = hull.clearance(lattice.points())[0]
    near = np.abs(exact) < 0.004
    np.testing.assert_allclose(found[near], exact[near], atol=1e-12)
    assert (np.sign(found) == np.sign(exact)).all()


def test_where_no_pose_says_anything_all_is_behind():
    source = np.array([[0.3, 0, 0]])
    hull = EchoHull(source, source[:, None], np.full((1, 1), -np.inf), -source / 0.3)
    lattice = Lattice.over(np.full(3, -0.01), np.full(3, 0.01), 0.002)
    found = clearance_grid(hull, lattice)
    assert (found > 0).all()
    assert np.isfinite(found).all()
