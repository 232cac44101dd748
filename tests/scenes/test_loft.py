# SPDX-License-Identifier: MIT
import numpy as np
import pytest
from sononerf_scenes.loft import evenly, loft

from sononerf.geometry.meshes import surface_faults


def test_a_straight_loft_is_a_body_of_revolution():
    along = np.array([2.0, -1.0, 2.0]) / 3.0
    at = np.linspace(0.0, 0.04, 41)
    radius = 0.005 * np.sin(np.pi * at / 0.04)
    body = loft(at[:, None] * along, radius)
    assert surface_faults(body) == []
    height = body.vertices @ along
    off = np.linalg.norm(body.vertices - height[:, None] * along, axis=1)
    np.testing.assert_allclose(off, np.interp(height, at, radius), atol=1e-9)
    # Thirty sides of a circle lose (2 pi / 30)^2 / 6, the profile's 40 about as little.
    assert body.volume == pytest.approx(np.pi * 0.005**2 * 0.04 / 2.0, rel=0.012)


def test_a_loft_along_a_helix_neither_twists_nor_thins():
    turn = np.linspace(0.0, 4.0 * np.pi, 400)
    path = np.stack([0.02 * np.cos(turn), 0.02 * np.sin(turn), 0.004 * turn], axis=1)
    body = loft(path, np.full(400, 0.003))
    assert surface_faults(body) == []
    rings = body.vertices[:-2].reshape(398, -1, 3)
    np.testing.assert_allclose(np.linalg.norm(rings - path[1:-1, None], axis=2), 0.003, rtol=1e-9)
    # A section square to the path all along: volume is its area times the length (Pappus).
    sides = rings.shape[1]
    area = 0.5 * sides * np.sin(2.0 * np.pi / sides) * 0.003**2
    assert body.volume == pytest.approx(area * np.hypot(0.02, 0.004) * turn[-2], rel=3e-3)
    # Neighbouring vertices of a ring and of the next one are as near as the rings are.
    step = np.linalg.norm(np.diff(rings, axis=0), axis=2)
    assert step.max() < 1.3 * np.linalg.norm(np.diff(path, axis=0), axis=1).max()


def test_points_are_even_and_keep_the_corners():
    corners = np.array([[0.0, 0.0, 0.0], [0.01, 0.0, 0.0], [0.01, 0.0, 0.0035]])
    points = evenly(corners, 0.001)
    np.testing.assert_allclose(points[[0, 10, -1]], corners)
    steps = np.linalg.norm(np.diff(points, axis=0), axis=1)
    np.testing.assert_allclose(steps, [*[0.001] * 10, *[0.000875] * 4])
