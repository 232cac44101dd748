# SPDX-License-Identifier: MIT
import numpy as np
import pytest
import trimesh

from sononerf.errors import InputError
from sononerf.geometry.plane import Plane

TABLE = Plane.through(np.array([0.1, 0.2, -0.01]), np.array([0.0, 0.0, 2.0]))
TILTED = Plane.through(np.array([0.1, 0.2, 0.3]), np.array([1.0, 2.0, 2.0]))


def test_images_lie_as_far_behind_a_plane():
    points = np.random.default_rng(0).normal(size=(20, 3))
    images = TILTED.mirrored(points)
    np.testing.assert_allclose(TILTED.height(images), -TILTED.height(points), atol=1e-12)
    np.testing.assert_allclose(TILTED.mirrored(images), points, atol=1e-12)
    # The way from a point to its image is square to the plane.
    across = np.cross(images - points, TILTED.normal)
    np.testing.assert_allclose(across, 0.0, atol=1e-12)
    ways = np.random.default_rng(1).normal(size=(20, 3))
    moved = TILTED.mirrored(points + ways) - images
    np.testing.assert_allclose(ways @ TILTED.turn, moved, atol=1e-12)


def test_a_body_in_the_air_has_an_image_of_its_own():
    ball = trimesh.creation.icosphere(subdivisions=3, radius=0.02)
    ball.apply_translation([0.0, 0.0, 0.02])
    both, kept = TABLE.with_image(ball)
    assert both.is_watertight
    assert both.body_count == 2
    assert kept.all()
    np.testing.assert_allclose(both.volume, 2 * ball.volume, rtol=1e-9)
    np.testing.assert_allclose(both.bounds[:, 2], [-0.06, 0.04], atol=1e-9)


def test_a_body_that_stands_is_one_with_its_image():
    box = trimesh.creation.box((0.04, 0.04, 0.04))
    box.apply_translation([0.0, 0.0, 0.01])  # from -10 to 30 mm, the table is at -10 mm
    both, kept = TABLE.with_image(box)
    assert both.is_watertight
    assert both.body_count == 1
    assert kept.sum() == len(box.faces) - 2  # without its base
    np.testing.assert_allclose(both.volume, 2 * box.volume, rtol=1e-9)


def test_what_is_below_a_plane_is_cut_off():
    ball = trimesh.creation.icosphere(subdivisions=4, radius=0.02)
    ball.apply_translation([0.0, 0.0, -0.01])  # the table cuts it in two
    both, kept = TABLE.with_image(ball)
    assert kept is None
    assert both.is_watertight
    assert both.body_count == 1
    np.testing.assert_allclose(both.volume, ball.volume, rtol=1e-3)
    with pytest.raises(InputError, match=r"below its support; raise it, or move support\.point"):
        TABLE.with_image(ball.apply_translation([0.0, 0.0, -0.03]))
