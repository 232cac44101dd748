# SPDX-License-Identifier: MIT
import io

import numpy as np
import pytest
import trimesh

from sononerf.errors import NumericalError
from sononerf.surface.mesh_files import confidence_colours, linear_light, mesh_bytes


@pytest.mark.parametrize("file_type", ["ply", "stl", "glb"])
def test_a_file_reads_back_as_the_same_body_and_is_always_the_same(file_type):
    mesh = trimesh.creation.icosphere(subdivisions=2, radius=0.015)
    mesh.apply_translation([0.1, 0.2, 0.3])
    data = mesh_bytes(mesh, file_type)
    back = trimesh.load(io.BytesIO(data), file_type=file_type, force="mesh")
    # glTF has y up by custom, yet coordinates are written as they are.
    np.testing.assert_allclose(back.bounds, mesh.bounds, atol=1e-7)
    assert back.volume == pytest.approx(mesh.volume, rel=1e-5)
    mesh.metadata["file_name"] = "/somewhere/else.ply"
    assert mesh_bytes(mesh, file_type) == data


def test_what_cannot_be_written_is_refused():
    mesh = trimesh.creation.box()
    with pytest.raises(ValueError, match="file_type"):
        mesh_bytes(mesh, "obj")
    with pytest.raises(NumericalError, match="empty"):
        mesh_bytes(trimesh.Trimesh(), "ply")
    broken = trimesh.Trimesh([[0, 0, 0], [1, 0, 0], [0, np.nan, 0]], [[0, 1, 2]], process=False)
    with pytest.raises(NumericalError, match="not finite"):
        mesh_bytes(broken, "ply")


@pytest.mark.parametrize("file_type", ["ply", "glb"])
def test_confidence_is_carried_as_colours(file_type):
    mesh = trimesh.creation.icosphere(subdivisions=1, radius=0.015)
    poses = np.arange(len(mesh.vertices)) * 3
    data = mesh_bytes(mesh, file_type, confidence=poses)
    assert mesh_bytes(mesh, file_type, confidence=poses) == data
    back = trimesh.load(io.BytesIO(data), file_type=file_type, force="mesh", process=False)
    expected = confidence_colours(poses)
    if file_type == "glb":  # glTF wants linear light
        expected = linear_light(expected)
    np.testing.assert_allclose(back.vertices, mesh.vertices, atol=1e-7)
    np.testing.assert_allclose(back.visual.vertex_colors[:, :3] / 255, expected, atol=0.003)


def test_ply_holds_the_numbers_of_poses_and_stl_nothing_new():
    mesh = trimesh.creation.icosphere(subdivisions=1, radius=0.015)
    poses = np.arange(len(mesh.vertices)) * 3
    data = mesh_bytes(mesh, "ply", confidence=poses)
    assert b"property int poses" in data.split(b"end_header")[0]
    back = trimesh.load(io.BytesIO(data), file_type="ply", process=False)
    read = back.metadata["_ply_raw"]["vertex"]["data"]["poses"]
    np.testing.assert_array_equal(np.ravel(read), poses)
    assert mesh_bytes(mesh, "stl", confidence=poses) == mesh_bytes(mesh, "stl")


@pytest.mark.parametrize("wrong", [[1, 2, 3], -1])
def test_a_wrong_confidence_is_refused(wrong):
    mesh = trimesh.creation.box()
    given = wrong if isinstance(wrong, list) else np.full(len(mesh.vertices), wrong)
    with pytest.raises(ValueError, match="confidence"):
        mesh_bytes(mesh, "ply", confidence=given)
