# SPDX-License-Identifier: MIT
import numpy as np
import pytest

from sononerf.errors import SettingsError
from sononerf.geometry.meshes import surface_faults
from sononerf.scene.scene import MATERIALS, load_scene


def test_a_plate_faces_x():
    mesh = load_scene("plate", {"sides": [0.08, 0.12]}).mesh
    np.testing.assert_allclose(mesh.bounds, [[-5e-4, -0.04, -0.06], [5e-4, 0.04, 0.06]])
    assert mesh.volume == pytest.approx(1e-3 * 0.08 * 0.12)
    assert surface_faults(mesh) == []
    ahead = mesh.face_normals[:, 0] > 0.99
    assert mesh.area_faces[ahead].sum() == pytest.approx(0.08 * 0.12)


def test_a_plate_is_turned_and_of_its_material():
    scene = load_scene("plate", {"sides": [0.08, 0.12], "yaw": 90.0, "material": "leaf"})
    np.testing.assert_allclose(scene.mesh.extents, [0.08, 0.001, 0.12], atol=1e-9)
    assert scene.material == MATERIALS["leaf"]


@pytest.mark.parametrize("options", [{"sides": [0.1]}, {"sides": [0.1, 0.6]}, {"thickness": 0.0}])
def test_other_sizes_are_refused(options):
    with pytest.raises(SettingsError, match=rf"scene\.options\.{next(iter(options))}"):
        load_scene("plate", options)
