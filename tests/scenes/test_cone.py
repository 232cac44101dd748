# SPDX-License-Identifier: MIT
import numpy as np
import pytest
from sononerf_scenes.bodies import EDGE, SIDE

from sononerf.errors import SettingsError
from sononerf.geometry.meshes import surface_faults
from sononerf.scene.scene import load_scene


@pytest.mark.parametrize(("radius", "height"), [(0.04, 0.09), (0.06, 0.01), (0.01, 0.12)])
def test_a_cone_has_a_tip_and_a_base(radius, height):
    mesh = load_scene("cone", {"radius": radius, "height": height}).mesh
    assert surface_faults(mesh) == []
    assert (mesh.euler_number, mesh.body_count) == (2, 1)
    assert mesh.edges_unique_length.max() <= EDGE
    above = mesh.vertices[:, 2] + height / 2.0
    around = np.hypot(mesh.vertices[:, 0], mesh.vertices[:, 1])
    # An odd number of sections moves the middle of the bounding box by some micrometres.
    slope = above > 1e-6
    np.testing.assert_allclose(around[slope], radius * (1.0 - above[slope] / height), atol=1e-5)
    assert around.max() == pytest.approx(radius, abs=1e-5)
    ratio = mesh.volume / (np.pi * radius**2 * height / 3.0)
    assert 1.0 - (SIDE / radius) ** 2 < ratio < 1.0


def test_a_cone_is_turned():
    mesh = load_scene("cone", {"pitch": 90.0}).mesh
    np.testing.assert_allclose(mesh.extents, [0.09, 0.08, 0.08], rtol=1e-3)
    tip = mesh.vertices[mesh.vertices[:, 0].argmax()]
    np.testing.assert_allclose(tip, [0.045, 0.0, 0.0], atol=1e-5)


@pytest.mark.parametrize("options", [{"radius": 0.0}, {"height": -1.0}, {"roll": 1000.0}])
def test_sizes_and_angles_have_bounds(options):
    with pytest.raises(SettingsError, match=rf"scene\.options\.{next(iter(options))}"):
        load_scene("cone", options)
