# SPDX-License-Identifier: MIT
import numpy as np
import pytest
import trimesh

from sononerf.geometry import inside
from sononerf.geometry.inside import winding_numbers

GENERATOR = np.random.default_rng(0)


def ball(radius=1.0, centre=(0.0, 0.0, 0.0)):
    mesh = trimesh.creation.icosphere(subdivisions=3, radius=radius)
    mesh.apply_translation(centre)
    return mesh


def solid_angle(mesh, point):
    """The winding number by van Oosterom and Strackee's formula."""
    a, b, c = np.moveaxis(mesh.triangles - point, 1, 0)
    la, lb, lc = (np.linalg.norm(v, axis=1) for v in (a, b, c))
    volume = np.einsum("td,td->t", a, np.cross(b, c))
    spread = la * lb * lc + (a * b).sum(1) * lc + (b * c).sum(1) * la + (c * a).sum(1) * lb
    return np.arctan2(volume, spread).sum() / (2 * np.pi)


def test_overlapping_and_inverted_bodies_are_counted():
    left, right = ball(centre=(-0.6, 0, 0)), ball(centre=(0.6, 0, 0))
    hollow = ball(0.2, (-0.8, 0, 0))
    hollow.invert()
    mesh = trimesh.util.concatenate([left, right, hollow])
    points = GENERATOR.uniform(-1.7, 1.7, (300, 3))
    expected = [solid_angle(mesh, point) for point in points]
    found = winding_numbers(mesh.vertices, mesh.faces, points)
    np.testing.assert_allclose(found, np.round(expected), atol=1e-12)
    assert {0.0, 1.0, 2.0} <= set(found)
    known = winding_numbers(mesh.vertices, mesh.faces, [[-0.8, 0, 0], [0, 0, 0], [-1.3, 0, 0]])
    assert known.tolist() == [0.0, 2.0, 1.0]


def test_points_in_line_with_corners_and_edges():
    box = trimesh.creation.box((2.0, 2.0, 2.0))
    steps = np.array([-0.5, 0.0, 0.5])
    points = np.stack(np.meshgrid(steps, steps, steps), axis=-1).reshape(-1, 3)
    np.testing.assert_allclose(winding_numbers(box.vertices, box.faces, points), 1.0)
    outside = points / np.abs(points).max(axis=1, keepdims=True).clip(1e-9) * 1.1
    outside = outside[np.abs(outside).max(axis=1) > 1]
    assert (winding_numbers(box.vertices, box.faces, outside) == 0.0).all()


def test_an_open_surface_fills_a_share_of_the_directions():
    plate = trimesh.Trimesh(
        [[-9, -9, 0], [9, -9, 0], [9, 9, 0], [-9, 9, 0]], [[0, 1, 2], [0, 2, 3]]
    )
    # Points have to be within the box of the surface to be looked at.
    tilted = plate.copy()
    tilted.apply_transform(trimesh.transformations.rotation_matrix(0.4, [1, 0, 0]))
    for height, sign in ((-0.1, 1), (0.1, -1)):
        found = winding_numbers(tilted.vertices, tilted.faces, [[0.0, 0.0, height]])
        np.testing.assert_allclose(found, sign * 0.5)


def test_many_pairs_are_taken_in_parts(monkeypatch):
    mesh, points = ball(), GENERATOR.uniform(-1, 1, (200, 3))
    whole = winding_numbers(mesh.vertices, mesh.faces, points)
    expected = [round(solid_angle(mesh, point)) for point in points]
    np.testing.assert_allclose(whole, expected, atol=1e-12)
    monkeypatch.setattr(inside, "PAIRS_AT_ONCE", 7)
    np.testing.assert_array_equal(winding_numbers(mesh.vertices, mesh.faces, points), whole)


@pytest.mark.parametrize("points", [np.zeros((0, 3)), [[5.0, 0.0, 0.0]]])
def test_no_point_near(points):
    mesh = ball()
    assert winding_numbers(mesh.vertices, mesh.faces, points).tolist() == [0.0] * len(points)
