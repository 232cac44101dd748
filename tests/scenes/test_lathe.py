# SPDX-License-Identifier: MIT
import numpy as np
import pytest
from sononerf_scenes.bodies import EDGE, SIDE
from sononerf_scenes.lathe import lathe

from sononerf.geometry.meshes import surface_faults

CYLINDER = [(0.0, 0.0), (0.02, 0.0), (0.02, 0.03), (0.0, 0.03)]


def test_a_profile_from_axis_to_axis_makes_a_closed_body_that_faces_outward():
    body = lathe(CYLINDER)
    assert surface_faults(body) == []
    assert body.euler_number == 2
    np.testing.assert_allclose(body.bounds[:, 2], [0.0, 0.03])
    exact = np.pi * 0.02**2 * 0.03
    assert 1.0 - (SIDE / 0.02) ** 2 / 3.0 < body.volume / exact < 1.0


def test_triangles_are_even_on_walls_slopes_and_flat_faces():
    body = lathe([(0.0, 0.0), (0.03, 0.0), (0.02, 0.01), (0.02, 0.03), (0.0, 0.03)])
    assert body.edges_unique_length.max() <= EDGE
    sides = body.triangles - np.roll(body.triangles, 1, axis=1)
    # One for an equilateral triangle, 0.87 for half a square; the first circle about the axis is
    # divided more finely.
    quality = 4.0 * np.sqrt(3.0) * body.area_faces / (sides**2).sum(axis=(1, 2))
    assert np.percentile(quality, 1.0) > 0.8
    assert quality.min() > 0.5
    away = np.hypot(*body.triangles_center[:, :2].T) > 0.003
    assert body.area_faces[away].min() > 0.2 * SIDE**2


@pytest.mark.parametrize("profile", [CYLINDER[1:], CYLINDER[:-1]])
def test_an_end_off_the_axis_is_a_hole(profile):
    body = lathe(profile)
    borders = np.bincount(body.edges_unique_inverse) == 1
    assert len(body.vertices) - len(body.edges_unique) + len(body.faces) == 1
    open_edges = body.edges_unique[borders]
    height = 0.0 if profile[0][0] else 0.03
    np.testing.assert_allclose(body.vertices[open_edges][..., 2], height)
    np.testing.assert_allclose(np.hypot(*body.vertices[open_edges][..., :2].T), 0.02)
