# SPDX-License-Identifier: MIT
import numpy as np

from sononerf.scene import Material
from sononerf.simulation.reflection import keep_outside, lobe_exponent, mirror, reflection


def test_default_material_has_the_originals_specular_numbers():
    found = reflection(Material(), [5e3, 20e3, np.sqrt(20e3 * 150e3), 150e3, 200e3])
    np.testing.assert_allclose(np.degrees(found.lobe_width), [12, 12, 8, 4, 4])
    np.testing.assert_allclose(found.strength, [1, 1, 0.85, 0.7, 0.7])
    np.testing.assert_allclose(found.kept, [1, 1, 0.85, 0.7, 0.7])


def test_mirror_keeps_along_and_turns_across():
    found = mirror(np.array([[0.6, 0.0, -0.8]]), np.array([[0.0, 0.0, 1.0]]))
    np.testing.assert_allclose(found, [[0.6, 0.0, 0.8]])
    np.testing.assert_allclose(
        mirror(np.array([[0.6, 0.0, -0.8]]), np.array([[0, 0, -1.0]])), found
    )


def test_directions_into_the_surface_are_turned_to_graze_it():
    flat = np.array([[0.0, 0.0, 1.0]] * 2)
    found = keep_outside(np.array([[0.6, 0.0, 0.8], [0.6, 0.0, -0.8]]), flat)
    np.testing.assert_allclose(found[0], [0.6, 0.0, 0.8])
    np.testing.assert_allclose(found[1], [1.0, 0.0, 0.0], atol=1e-3)
    assert found[1, 2] > 0.0


def test_lobe_is_a_gaussian_of_the_angle():
    theta, width = np.array([0.0, 0.1, 0.2]), np.array([0.1, 0.4])
    found = np.exp(lobe_exponent(np.cos(theta), width))
    np.testing.assert_allclose(found[:, 0], [1.0, np.exp(-0.5), np.exp(-2.0)], rtol=1e-9)
    np.testing.assert_allclose(found[1, 1], np.exp(-1 / 32), rtol=1e-9)
    assert np.exp(lobe_exponent(np.array([1.0 + 1e-16]), width)).max() == 1.0
