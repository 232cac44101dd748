# SPDX-License-Identifier: MIT
import numpy as np
import pytest
from sononerf_scenes.sheet import Outline, filled, two_sided

from sononerf.geometry.meshes import surface_faults

SPACING = 0.001


def outline(kind):
    x = np.linspace(0.0, 0.03, 200)
    share = x / 0.03
    if kind == "rectangle":
        return Outline(x, np.full(200, -0.005), np.full(200, 0.005))
    if kind == "lens":
        return Outline(x, -0.02 * share * (1 - share), 0.03 * share * (1 - share))
    return Outline(x, -0.002 - 0.003 * share**4, 0.002 + 0.004 * np.cos(2 * np.pi * share) ** 2)


def flat_area(points, triangles):
    a, b, c = points[triangles].transpose(1, 0, 2)
    return ((b - a)[:, 0] * (c - a)[:, 1] - (b - a)[:, 1] * (c - a)[:, 0]) / 2.0


@pytest.mark.parametrize("kind", ["rectangle", "lens", "hollow"])
def test_an_outline_is_filled_once_with_even_triangles(kind):
    shape = outline(kind)
    points, triangles = filled(shape, SPACING)
    area = flat_area(points, triangles)
    assert area.min() > 0.0
    rim = shape.rim(0.9 * SPACING)
    around = np.sum(rim[:, 0] * np.roll(rim[:, 1], -1) - rim[:, 1] * np.roll(rim[:, 0], -1)) / 2.0
    assert area.sum() == pytest.approx(around, rel=1e-9)  # no gap, no overlap, nothing beyond
    edges = points[triangles] - points[np.roll(triangles, 1, axis=1)]
    assert np.linalg.norm(edges, axis=-1).max() <= 1.7 * SPACING
    # Midrib: a row of points lies on y = 0.
    assert (np.abs(points[:, 1]) < 1e-12).sum() > 20


def test_the_rim_keeps_corners_and_runs_counter_clockwise():
    rim = outline("rectangle").rim(0.0009)
    corners = {(0.0, -0.005), (0.03, -0.005), (0.03, 0.005), (0.0, 0.005)}
    assert corners <= {(round(x, 9), round(y, 9)) for x, y in rim}
    assert np.linalg.norm(rim - np.roll(rim, 1, axis=0), axis=1).max() <= 0.0009 + 1e-12
    x, y = rim.T
    assert np.sum(x * np.roll(y, -1) - y * np.roll(x, -1)) / 2.0 == pytest.approx(0.03 * 0.01)


def test_what_an_outline_contains_has_a_margin():
    shape = outline("rectangle")
    middle = np.array([[0.015, 0.0]])
    near = np.array([[0.015, 0.0045], [0.015, -0.0045], [0.0295, 0.0], [0.0005, 0.0]])
    beyond = np.array([[0.015, 0.0055], [0.015, -0.0055], [0.0305, 0.0], [-0.0005, 0.0]])
    assert shape.contains(middle, 0.001).all()
    assert shape.contains(near).all()
    assert not shape.contains(near, 0.001).any()
    assert not shape.contains(beyond).any()
    assert shape.contains(beyond, -0.001).all()


def test_two_sides_and_a_rim_make_a_closed_body():
    points, triangles = filled(outline("rectangle"), SPACING)
    height = np.full((len(points), 1), 0.0004)
    top, bottom = np.hstack([points, height]), np.hstack([points, 0.0 * height])
    mesh = two_sided(top, bottom, triangles)
    assert surface_faults(mesh) == []
    assert mesh.euler_number == 2
    assert mesh.volume == pytest.approx(0.03 * 0.01 * 0.0004)
    assert mesh.area == pytest.approx(2 * 0.03 * 0.01 + 2 * 0.04 * 0.0004)
    np.testing.assert_array_equal(mesh.vertices[: len(top)], top)
