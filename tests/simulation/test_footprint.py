# SPDX-License-Identifier: MIT
import numpy as np

from sononerf.geometry.directions import fibonacci_sphere
from sononerf.simulation.footprint import Footprint, emit, land, onto

NO_BEND = np.zeros((1, 4, 3), np.float32)


def products(one, other):
    """Scalar products of the first vector with the first, second with second, first with second."""
    one, other = (np.asarray(part, float).reshape(-1, 2, 3) for part in (one, other))
    return np.einsum("hkd,hld->hkl", one, other).reshape(-1, 4)[:, [0, 3, 1]]


def test_bundles_are_turned_about_two_vectors_square_to_any_direction():
    """Also to those along the axes, where other frames break down."""
    axes = np.concatenate([np.eye(3), -np.eye(3), [[1e-9, 0, -1]], fibonacci_sphere(200)])
    axes /= np.linalg.norm(axes, axis=1, keepdims=True)
    bundles = emit(axes, np.full(len(axes), 0.5))
    turn = bundles[:, 6:]
    np.testing.assert_allclose(bundles[:, :6], 0.5 * turn)
    np.testing.assert_allclose(products(turn, turn), [[1, 1, 0]] * len(axes), atol=1e-6)
    along = np.einsum("hkd,hd->hk", turn.reshape(-1, 2, 3), axes)
    np.testing.assert_allclose(along, 0.0, atol=1e-6)


def plane(slope, side=1.0):
    """A bundle 0.5 m from the emitter that falls on a plate under an angle of incidence."""
    incoming = np.array([[1.0, 0.0, 0.0]])
    normal = np.array([[-np.cos(slope), np.sin(slope), 0.0]])
    bundles = emit(incoming, np.array([0.5]))
    rows, *others = land(bundles, incoming, side * normal, side * normal, NO_BEND)
    return Footprint(rows), *others


def test_a_bundle_on_a_slope_is_longer_and_no_wider():
    for slope in (0.0, 0.5, 1.4):
        footprint, turned, _, _ = plane(slope)
        np.testing.assert_allclose(footprint.sink, -np.cos(slope), rtol=1e-5)
        np.testing.assert_allclose(footprint.tube, 0.25, rtol=1e-6)
        lit = np.cross(footprint.shift[0, :, 0], footprint.shift[1, :, 0])
        np.testing.assert_allclose(np.linalg.norm(lit), 0.25 / np.cos(slope), rtol=1e-5)
        normal = np.array([-np.cos(slope), np.sin(slope), 0.0])
        np.testing.assert_allclose(footprint.shift[:, :, 0] @ normal, 0.0, atol=1e-6)
        # A flat mirror turns directions and keeps their angles.
        np.testing.assert_allclose(products(turned, turned)[0], [1.0, 1.0, 0.0], atol=1e-6)
        np.testing.assert_allclose(footprint.curving, 0.0)


def test_either_side_of_a_plate_mirrors_alike():
    for slope in (0.0, 0.5, 1.4):
        for side in (1.0, -1.0):
            footprint, _, flat, mirrored = plane(slope, side)
            np.testing.assert_allclose(flat, [[-np.cos(slope), np.sin(slope), 0.0]])
            expected = [[-np.cos(2 * slope), np.sin(2 * slope), 0.0]]
            np.testing.assert_allclose(mirrored, expected, atol=1e-15)
            np.testing.assert_array_equal(footprint.rows, plane(slope)[0].rows)


def test_a_mirrored_bundle_grows_on_as_before():
    """Off a plate it is as wide as it would be straight on."""
    footprint, turned, _, _ = plane(0.5)
    bundles = onto(footprint.rows, turned, np.array([0, 0]), np.array([0.1, 0.7]))
    np.testing.assert_array_equal(bundles[:, 6:], turned[[0, 0]])
    mirrored = np.array([[-np.cos(1.0), np.sin(1.0), 0.0]] * 2)
    bend = np.zeros((2, 4, 3), np.float32)
    rows, *_ = land(bundles, mirrored, -mirrored, -mirrored, bend)
    np.testing.assert_allclose(Footprint(rows).tube, [0.6**2, 1.2**2], rtol=1e-5)
