# SPDX-License-Identifier: MIT
import numpy as np
import pytest
from sononerf_scenes.bodies import EDGE

from sononerf.errors import SettingsError
from sononerf.geometry.meshes import surface_faults
from sononerf.scene.scene import load_scene


@pytest.mark.parametrize(("width", "height", "steps"), [(0.09, 0.09, 3), (0.06, 0.1, 2)])
def test_a_tower_is_storeys_of_equal_steps(width, height, steps):
    mesh = load_scene("tower", {"width": width, "height": height, "steps": steps}).mesh
    assert surface_faults(mesh) == []
    assert (mesh.euler_number, mesh.body_count) == (2, 1)
    assert mesh.edges_unique_length.max() <= EDGE
    half = np.array([width, width, height]) / 2.0
    np.testing.assert_allclose(mesh.bounds, [-half, half], atol=1e-9)
    sides = width * np.arange(1, steps + 1) / steps
    assert mesh.volume == pytest.approx(height / steps * (sides**2).sum(), rel=1e-6)
    # From above and below all is seen once; the walls are of one height.
    area = 2.0 * width**2 + 4.0 * height / steps * sides.sum()
    assert mesh.area == pytest.approx(area, rel=1e-6)


def test_a_tower_has_right_angles_outward_and_inward():
    mesh = load_scene("tower").mesh
    sharp = mesh.face_adjacency_angles > 0.1
    np.testing.assert_allclose(mesh.face_adjacency_angles[sharp], np.pi / 2.0, atol=1e-5)
    ends = mesh.vertices[mesh.face_adjacency_edges[sharp & ~mesh.face_adjacency_convex]]
    length = np.linalg.norm(np.diff(ends, axis=1)[:, 0], axis=1).sum()
    # Around the feet of the two upper storeys, 0.06 m and 0.03 m wide.
    assert length == pytest.approx(4.0 * (0.06 + 0.03), rel=1e-5)
    np.testing.assert_allclose(np.unique(ends[..., 2].round(6)), [-0.015, 0.015])


def test_a_tower_is_turned():
    mesh = load_scene("tower", {"width": 0.06, "pitch": 90.0}).mesh
    np.testing.assert_allclose(mesh.extents, [0.09, 0.06, 0.06], atol=1e-9)
    ahead = mesh.vertices[:, 0] > 0.0449
    assert np.abs(mesh.vertices[ahead][:, 1]).max() == pytest.approx(0.01)


@pytest.mark.parametrize("options", [{"steps": 1}, {"steps": 9}, {"width": 0.0}, {"height": 1.0}])
def test_sizes_and_steps_have_bounds(options):
    with pytest.raises(SettingsError, match=rf"scene\.options\.{next(iter(options))}"):
        load_scene("tower", options)
