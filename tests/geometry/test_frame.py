# SPDX-License-Identifier: MIT
"""The frame of recordings, and the way back to it."""

from __future__ import annotations

import numpy as np
import pytest
import trimesh
from scipy.spatial.transform import Rotation

from sononerf.errors import InputError
from sononerf.geometry.frame import Frame
from sononerf.recordings.pose_tables import original_frame, read_table, to_poses
from sononerf.settings.import_schema import ImportSettings

FRAMES = {
    "ned": {"frame": "ned"},
    "camera": {"frame": "camera"},
    "left-handed": {"frame": "own", "axes": [[1, 0, 0], [0, -1, 0], [0, 0, 1]]},
    "turned": {"frame": "own", "axes": [[0.6, 0.8, 0], [-0.8, 0.6, 0], [0, 0, 1]]},
}


@pytest.fixture(params=FRAMES)
def recorded(request, tmp_path):
    """Settings of an import, a table in mm, its poses in the world, and the frame."""
    settings = ImportSettings(**FRAMES[request.param])
    rng = np.random.default_rng(1)
    quaternion = rng.normal(size=(9, 4))
    quaternion /= np.linalg.norm(quaternion, axis=1, keepdims=True)
    rows = np.hstack([rng.uniform(-500, 500, (9, 3)), quaternion])
    text = "\n".join(",".join(map(repr, row)) for row in rows.tolist())
    file = tmp_path / "poses.csv"
    file.write_text(f"x_mm,y_mm,z_mm,qw,qx,qy,qz\n{text}\n")
    columns = read_table(file, settings)
    stated = {"origin": "recorded", **original_frame(columns, settings)}
    return settings, rows, to_poses(columns, settings), Frame.of(stated)


def test_places_of_poses_come_back(recorded):
    _, rows, poses, frame = recorded
    assert (frame.unit_name, frame.is_world) == ("mm", False)
    np.testing.assert_allclose(frame.places(poses.positions), rows[:, :3], atol=1e-9)
    turned = frame.rotations(poses.rotations)
    expected = Rotation.from_quat(rows[:, 3:], scalar_first=True).as_matrix()
    np.testing.assert_allclose(turned, expected, atol=1e-9)


def test_a_mesh_goes_there_and_back(recorded):
    _, _, _, frame = recorded
    mesh = trimesh.creation.box((0.02, 0.03, 0.05))
    mesh.apply_translation([0.1, 0.2, 0.3])
    there = frame.mesh(mesh)
    np.testing.assert_allclose(there.volume, 1e9 * mesh.volume)  # outward, in cubic millimetres
    np.testing.assert_allclose(frame.places(mesh.vertices), there.vertices)
    metres = trimesh.Trimesh(there.vertices * 1e-3, there.faces, process=False)
    back = frame.to_world(metres)
    np.testing.assert_allclose(back.vertices, mesh.vertices, atol=1e-12)
    assert back.volume == pytest.approx(mesh.volume)
    length = np.linalg.norm(frame.directions(mesh.vertex_normals), axis=1)
    np.testing.assert_allclose(length, 1.0)


def test_recordings_alone_have_it_by_default():
    matrix = np.diag([1e3, 1e3, 1e3, 1.0]).tolist()
    assert Frame.of({"origin": "simulated", "to_original": matrix}).is_world
    assert Frame.of({"origin": "simulated", "to_original": matrix}, "original").unit_name == "mm"
    assert Frame.of({"origin": "recorded", "to_original": matrix}, "world").is_world
    assert Frame.of({"origin": "recorded"}).is_world  # a turntable


@pytest.mark.parametrize("matrix", [np.eye(3), np.diag([1, 2, 3, 1]), np.zeros((4, 4))])
def test_a_matrix_that_is_no_similarity_is_refused(matrix):
    with pytest.raises(InputError, match="to_original is no"):
        Frame.of({"origin": "recorded", "to_original": matrix.tolist()})
