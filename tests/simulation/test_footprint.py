# SPDX-License-Identifier: MIT
import numpy as np

from sononerf.geometry.directions import fibonacci_sphere
from sononerf.simulation.footprint import across, dots, land, pairs


def single(vectors):
    return np.asarray(vectors, np.float32).T.copy()


def test_two_vectors_square_to_any_direction():
    """Also to those along the axes, where other frames break down."""
    axes = np.concatenate([np.eye(3), -np.eye(3), [[1e-9, 0, -1]], fibonacci_sphere(200)])
    axes = single(axes / np.linalg.norm(axes, axis=1, keepdims=True))
    first, second = across(axes)
    for one, two, expected in (
        (first, first, 1), (second, second, 1), (first, second, 0), (first, axes, 0),
        (second, axes, 0),
    ):  # fmt: skip
        np.testing.assert_allclose(dots(one, two), expected, atol=1e-6)


def plane(slope):
    """Bundles 0.5 m from the emitter that fall on a plate under an angle of incidence."""
    incoming = single([[1.0, 0.0, 0.0]])
    normal = single([[-np.cos(slope), np.sin(slope), 0.0]])
    turn = across(incoming)
    return land(
        0.5 * turn,
        turn,
        incoming=incoming,
        flat=normal,
        normals=normal,
        gradients=np.zeros((4, 3, 1), np.float32),
    )


def test_a_bundle_on_a_slope_is_longer_and_no_wider():
    for slope in (0.0, 0.5, 1.4):
        footprint, turned = plane(slope)
        np.testing.assert_allclose(footprint.sink, -np.cos(slope), rtol=1e-5)
        np.testing.assert_allclose(footprint.tube, 0.25, rtol=1e-6)
        lit = np.cross(footprint.shift[0, :, 0], footprint.shift[1, :, 0])
        np.testing.assert_allclose(np.linalg.norm(lit), 0.25 / np.cos(slope), rtol=1e-5)
        normal = np.array([-np.cos(slope), np.sin(slope), 0.0])
        np.testing.assert_allclose(footprint.shift[:, :, 0] @ normal, 0.0, atol=1e-6)
        # A flat mirror turns directions and keeps their angles.
        np.testing.assert_allclose(pairs(turned, turned)[:, 0], [1.0, 1.0, 0.0], atol=1e-6)
        np.testing.assert_allclose(footprint.curving, 0.0)


def test_footprints_are_cut_ray_by_ray():
    incoming = fibonacci_sphere(9)
    turn = across(single(incoming))
    flat = single(-incoming)
    footprint, _ = land(
        0.5 * turn,
        turn,
        incoming=single(incoming),
        flat=flat,
        normals=flat,
        gradients=np.ones((4, 3, 9), np.float32),
    )
    few = footprint[np.array([7, 2])]
    for name in ("shift", "square", "bend", "curving", "onward", "sink", "tube"):
        expected = getattr(footprint, name)[..., [7, 2]]
        np.testing.assert_array_equal(getattr(few, name), expected)
