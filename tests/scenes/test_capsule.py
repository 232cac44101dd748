# SPDX-License-Identifier: MIT
import numpy as np
import pytest
from sononerf_scenes.bodies import EDGE, SIDE

from sononerf.errors import SettingsError
from sononerf.geometry.meshes import surface_faults
from sononerf.scene.scene import load_scene


def test_a_capsule_stands_upright_about_the_origin():
    mesh = load_scene("capsule").mesh
    assert surface_faults(mesh) == []
    np.testing.assert_allclose(mesh.bounds[:, 2], [-0.045, 0.045], atol=1e-9)
    np.testing.assert_allclose(mesh.extents[:2], 0.03, rtol=1e-3)
    assert mesh.edges_unique_length.max() <= EDGE
    exact = np.pi * 0.015**2 * 0.06 + 4.0 / 3.0 * np.pi * 0.015**3
    # Polygons of sides s instead of circles lose (s/r)^2 / 6; half spheres twice that.
    assert 1.0 - (SIDE / 0.015) ** 2 / 3.0 < mesh.volume / exact < 1.0


def test_a_capsule_is_turned():
    mesh = load_scene("capsule", {"length": 0.1, "radius": 0.01, "roll": 90.0}).mesh
    np.testing.assert_allclose(mesh.extents, [0.02, 0.12, 0.02], rtol=2e-3)


@pytest.mark.parametrize("options", [{"length": 0.0}, {"radius": -1.0}, {"yaw": 1000.0}])
def test_sizes_and_angles_have_bounds(options):
    with pytest.raises(SettingsError, match=rf"scene\.options\.{next(iter(options))}"):
        load_scene("capsule", options)
