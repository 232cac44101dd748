# SPDX-License-Identifier: MIT
"""The frame of recordings, and the way back to it."""

from __future__ import annotations

import numpy as np
import pytest
import trimesh
from scipy.spatial.transform import Rotation

from sononerf.errors import InputError
from sononerf.geometry.meshes import Plane
from sononerf.geometry.poses import Frame
from sononerf.recordings.pose_tables import original_frame, read_table, to_poses
from sononerf.settings.sections import ImportSettings

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


TABLE = Plane.through(np.array([0.1, 0.2, -0.01]), np.array([0.0, 0.0, 2.0]))
TILTED = Plane.through(np.array([0.1, 0.2, 0.3]), np.array([1.0, 2.0, 2.0]))


def test_images_lie_as_far_behind_a_plane():
    points = np.random.default_rng(0).normal(size=(20, 3))
    images = TILTED.mirrored(points)
    np.testing.assert_allclose(TILTED.height(images), -TILTED.height(points), atol=1e-12)
    np.testing.assert_allclose(TILTED.mirrored(images), points, atol=1e-12)
    # The way from a point to its image is square to the plane.
    across = np.cross(images - points, TILTED.normal)
    np.testing.assert_allclose(across, 0.0, atol=1e-12)
    ways = np.random.default_rng(1).normal(size=(20, 3))
    moved = TILTED.mirrored(points + ways) - images
    np.testing.assert_allclose(ways @ TILTED.reflection, moved, atol=1e-12)


def test_a_body_in_the_air_has_an_image_of_its_own():
    ball = trimesh.creation.icosphere(subdivisions=3, radius=0.02)
    ball.apply_translation([0.0, 0.0, 0.02])
    both, kept = TABLE.with_image(ball)
    assert both.is_watertight
    assert both.body_count == 2
    assert kept.all()
    np.testing.assert_allclose(both.volume, 2 * ball.volume, rtol=1e-9)
    np.testing.assert_allclose(both.bounds[:, 2], [-0.06, 0.04], atol=1e-9)


def test_a_body_that_stands_is_one_with_its_image():
    box = trimesh.creation.box((0.04, 0.04, 0.04))
    box.apply_translation([0.0, 0.0, 0.01])  # from -10 to 30 mm, the table is at -10 mm
    both, kept = TABLE.with_image(box)
    assert both.is_watertight
    assert both.body_count == 1
    assert kept.sum() == len(box.faces) - 2  # without its base
    np.testing.assert_allclose(both.volume, 2 * box.volume, rtol=1e-9)


def test_what_is_below_a_plane_is_cut_off():
    ball = trimesh.creation.icosphere(subdivisions=4, radius=0.02)
    ball.apply_translation([0.0, 0.0, -0.01])  # the table cuts it in two
    both, kept = TABLE.with_image(ball)
    assert kept is None
    assert both.is_watertight
    assert both.body_count == 1
    np.testing.assert_allclose(both.volume, ball.volume, rtol=1e-3)
    with pytest.raises(InputError, match=r"below its support; raise it, or move support\.point"):
        TABLE.with_image(ball.apply_translation([0.0, 0.0, -0.03]))
