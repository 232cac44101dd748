# SPDX-License-Identifier: MIT
import numpy as np
import pytest
import trimesh

from sononerf.evaluation.solid import Nearest


@pytest.fixture(scope="module")
def body():
    """A long, coarse box beside a fine ball: triangles of very different sizes."""
    ball = trimesh.creation.icosphere(subdivisions=4, radius=0.4)
    ball.apply_translation([3, 0, 0])
    return trimesh.util.concatenate([trimesh.creation.box((2, 2, 8)), ball])


@pytest.fixture(scope="module")
def places(body):
    generator = np.random.default_rng(0)
    low, high = body.bounds
    return np.concatenate([generator.uniform(low - 3, high + 3, (400, 3)), body.vertices[:20]])


def on_paper(points):
    """Distances from box and ball, negative inside."""
    outside = np.abs(points) - [1, 1, 4]
    box = np.linalg.norm(np.maximum(outside, 0), axis=1) + np.minimum(outside.max(axis=1), 0)
    return box, np.linalg.norm(points - [3, 0, 0], axis=1) - 0.4


def test_distances_are_those_on_paper(body, places):
    found = Nearest(body).distance(places)
    expected = np.abs(on_paper(places)).min(axis=0)
    # The ball's facets lie up to 0.2 % of its radius below it.
    np.testing.assert_allclose(found, expected, atol=1e-3)


def test_distances_are_exact_in_any_order(body, places):
    def exact(place):
        corners = np.asarray(body.triangles)
        there = trimesh.triangles.closest_point(corners, np.tile(place, (len(corners), 1)))
        return np.linalg.norm(there - place, axis=1).min()

    nearest = Nearest(body)
    found = nearest.distance(places)
    np.testing.assert_allclose(found[::20], [exact(place) for place in places[::20]], atol=1e-12)
    np.testing.assert_array_equal(nearest.distance(places[::-1]), found[::-1])


@pytest.mark.parametrize("limit", [0.05, 0.5, 2.0])
def test_near_is_a_distance_up_to_the_limit(body, places, limit):
    nearest = Nearest(body)
    near = nearest.near(places, limit)
    assert 0 < near.sum() < len(places)
    np.testing.assert_array_equal(near, nearest.distance(places) <= limit)


def test_corners_that_no_triangle_uses_do_not_count():
    mesh = trimesh.Trimesh(
        [[0, 0, 0], [1, 0, 0], [0, 1, 0], [5, 5, 5]], [[0, 1, 2]], process=False, validate=False
    )
    nearest = Nearest(mesh)
    assert nearest.distance(np.array([[5.0, 5.0, 5.0]])) == pytest.approx(np.sqrt(40.5 + 25))
    assert not nearest.near(np.array([[5.0, 5.0, 5.0]]), 1.0).any()


def test_a_triangle_without_an_area_hides_nothing():
    mesh = trimesh.Trimesh(
        [[0, 0, 0], [1, 0, 0], [0, 1, 0], [3, 3, 3]],
        [[0, 1, 2], [3, 3, 3]],
        process=False,
        validate=False,
    )
    place = np.array([[3.0, 3.0, 3.5]])
    expected = np.sqrt(2 * 2.5**2 + 3.5**2)  # from the middle of the long side
    assert Nearest(mesh).distance(place) == pytest.approx(expected)


def test_no_places_have_no_distances(body):
    nothing = np.zeros((0, 3))
    nearest = Nearest(body)
    assert nearest.distance(nothing).shape == (0,)
    assert nearest.near(nothing, 1.0).shape == (0,)
