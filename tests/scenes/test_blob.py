# SPDX-License-Identifier: MIT
import numpy as np
import pytest
from sononerf_scenes.bodies import EDGE

from sononerf.errors import SettingsError
from sononerf.geometry.meshes import surface_faults
from sononerf.scene.scene import load_scene


@pytest.mark.parametrize("seed", [0, 1, 2])
def test_a_blob_is_one_smooth_closed_body(seed):
    mesh = load_scene("blob", {"seed": seed}).mesh
    assert surface_faults(mesh) == []
    assert (mesh.euler_number, mesh.body_count) == (2, 1)
    assert mesh.edges_unique_length.max() <= EDGE
    assert mesh.volume == pytest.approx(4.0 / 3.0 * np.pi * 0.045**3, rel=1e-6)
    np.testing.assert_allclose(mesh.bounds.mean(axis=0), 0.0, atol=1e-9)
    assert 0.08 < mesh.extents.max() < 0.15
    # Its neighbouring triangles meet at far less than the angle of an edge.
    assert np.degrees(mesh.face_adjacency_angles.max()) < 20.0


def test_the_seed_alone_decides():
    first, again, other = (load_scene("blob", {"seed": seed}).mesh for seed in (3, 3, 4))
    np.testing.assert_array_equal(first.vertices, again.vertices)
    assert first.vertices.shape != other.vertices.shape or (first.vertices != other.vertices).any()


def test_without_roughness_it_is_a_ball_and_with_more_it_is_less_of_one():
    ball, mild, rough = (
        load_scene("blob", {"radius": 0.03, "roughness": roughness}).mesh
        for roughness in (0.0, 0.1, 0.3)
    )
    np.testing.assert_allclose(np.linalg.norm(ball.vertices, axis=1), 0.03, rtol=2e-3)
    assert ball.area < 0.99 * mild.area < 0.98 * rough.area
    assert rough.edges_unique_length.max() <= EDGE


def test_a_blob_is_turned():
    plain, turned = (load_scene("blob", {"yaw": yaw}).mesh for yaw in (0.0, 90.0))
    np.testing.assert_allclose(turned.extents, plain.extents[[1, 0, 2]], atol=1e-8)


@pytest.mark.parametrize("options", [{"seed": -1}, {"radius": 0.0}, {"roughness": 0.5}])
def test_options_have_bounds(options):
    with pytest.raises(SettingsError, match=rf"scene\.options\.{next(iter(options))}"):
        load_scene("blob", options)
