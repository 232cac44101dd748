# SPDX-License-Identifier: MIT
import numpy as np
import pytest

from sononerf.errors import SettingsError
from sononerf.geometry.meshes import surface_faults
from sononerf.scene.scene import load_scene


def test_a_box_has_its_size_about_the_origin():
    mesh = load_scene("box", {"size": [0.1, 0.06, 0.02]}).mesh
    np.testing.assert_allclose(mesh.bounds, [[-0.05, -0.03, -0.01], [0.05, 0.03, 0.01]])
    assert mesh.volume == pytest.approx(0.1 * 0.06 * 0.02)
    assert surface_faults(mesh) == []


def test_a_box_is_turned():
    mesh = load_scene("box", {"size": [0.1, 0.06, 0.02], "yaw": 90.0, "roll": 90.0}).mesh
    # Roll takes y to z, yaw then takes x to y and z's place stays.
    np.testing.assert_allclose(mesh.extents, [0.02, 0.1, 0.06], atol=1e-9)


@pytest.mark.parametrize("size", [[0.1, 0.1], [0.1, 0.1, 0.0], [0.1, 0.1, 9.0], 0.1])
def test_other_sizes_are_refused(size):
    with pytest.raises(SettingsError, match=r"scene\.options\.size"):
        load_scene("box", {"size": size})
