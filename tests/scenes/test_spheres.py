# SPDX-License-Identifier: MIT
import numpy as np
import pytest

from sononerf.scene.scene import load_scene


def bodies(scene):
    parts = scene.mesh.split(only_watertight=True)
    return sorted((part.bounds.mean(axis=0).tolist(), part.extents.max() / 2) for part in parts)


def test_sphere_is_round_and_closed():
    mesh = load_scene("sphere", {"radius": 0.02}).mesh
    np.testing.assert_allclose(np.linalg.norm(mesh.vertices, axis=1), 0.02)
    assert mesh.is_watertight
    assert 0.995 < mesh.volume / (4 / 3 * np.pi * 0.02**3) < 1.0


def test_three_spheres_stand_in_an_l_about_their_mean():
    found = bodies(load_scene("three_spheres"))
    assert len(found) == 3
    centres = np.array([centre for centre, _ in found])
    np.testing.assert_allclose(centres.mean(axis=0), 0.0, atol=1e-12)
    np.testing.assert_allclose([radius for _, radius in found], 0.015)
    # From the coordinates of the paper's scene: 3.28 and 4.27 radii along z and y.
    spans = np.ptp(centres, axis=0) / 0.015
    np.testing.assert_allclose(spans, [0.0, 4.29, 3.28], atol=1e-9)


def test_ua_has_nineteen_bodies_of_the_size_asked_for():
    mesh = load_scene("ua", {"radius": 0.01}).mesh
    found = bodies(load_scene("ua", {"radius": 0.01}))
    assert len(found) == 19
    np.testing.assert_allclose(np.mean([c for c, _ in found], axis=0), 0.0, atol=1e-12)
    # Widest from y = -6.19 to 6.93 and highest from z = -0.01 to 7.54, plus a radius each side.
    np.testing.assert_allclose(mesh.extents, [0.02, 0.1512, 0.0955], atol=1e-9)


@pytest.mark.parametrize("name", ["three_spheres", "ua"])
def test_ua_and_spheres_face_outward(name):
    mesh = load_scene(name).mesh
    assert mesh.is_watertight
    assert mesh.volume > 0
