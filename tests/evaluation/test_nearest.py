# SPDX-License-Identifier: MIT
import numpy as np
import pytest
import trimesh

from sononerf.evaluation.nearest import Nearest, polydata


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


def test_both_ways_of_asking_agree(body, places):
    nearest = Nearest(body)
    np.testing.assert_array_equal(nearest.distance(places), np.abs(nearest.signed(places)))
    np.testing.assert_array_equal(nearest.distance(places[::-1]), nearest.distance(places)[::-1])


def test_inside_is_negative(body, places):
    away = np.abs(on_paper(places)).min(axis=0) > 2e-3
    inside = np.min(on_paper(places), axis=0) < 0
    np.testing.assert_array_equal(Nearest(body).signed(places)[away] < 0, inside[away])


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
    found = Nearest(mesh).distance(place)
    np.testing.assert_array_equal(found, np.abs(Nearest(mesh).signed(place)))
    assert np.isfinite(found).all()


def test_no_places_have_no_distances(body):
    nothing = np.zeros((0, 3))
    nearest = Nearest(body)
    assert nearest.distance(nothing).shape == nearest.signed(nothing).shape == (0,)
    assert nearest.near(nothing, 1.0).shape == (0,)


def test_polydata_has_the_same_triangles(body):
    assert polydata(body).n_cells == len(body.faces)
