# SPDX-License-Identifier: MIT
import numpy as np
import pytest

from sononerf.errors import InputError
from sononerf.geometry.poses import (
    Poses,
    aim_fault,
    cap_poses,
    euler_from_rotation,
    look_at,
    off_axis,
    random_poses,
    random_sphere_poses,
    rotation_from_euler,
)


def test_positive_pitch_looks_down_and_positive_yaw_left():
    np.testing.assert_allclose(
        rotation_from_euler(0.0, np.pi / 2, 0.0)[:, 0], [0, 0, -1], atol=1e-12
    )
    np.testing.assert_allclose(
        rotation_from_euler(np.pi / 2, 0.0, 0.0)[:, 0], [0, 1, 0], atol=1e-12
    )


@pytest.mark.parametrize("pitch", [np.pi / 2, -np.pi / 2])
def test_straight_up_or_down_yaw_is_zero_and_the_rotation_the_same(pitch):
    rotation = rotation_from_euler(0.7, pitch, 0.2)
    yaw, found_pitch, roll = euler_from_rotation(rotation)
    assert yaw == 0.0
    np.testing.assert_allclose(rotation_from_euler(yaw, found_pitch, roll), rotation, atol=1e-9)


def test_look_at_looks_there_and_is_level():
    positions = np.random.default_rng(2).normal(size=(50, 3))
    target = np.array([0.1, 0.2, -0.3])
    rotations = look_at(positions, target)
    forward = (target - positions) / np.linalg.norm(target - positions, axis=1, keepdims=True)
    np.testing.assert_allclose(rotations[:, :, 0], forward, atol=1e-12)
    np.testing.assert_allclose(rotations[:, 2, 1], 0.0, atol=1e-12)  # the left ear's axis is level
    assert (rotations[:, 2, 2] >= 0.0).all()  # and nobody flies head down


def test_look_at_straight_down_has_no_yaw():
    yaw, pitch, roll = euler_from_rotation(look_at([0.0, 0.0, 2.0], np.zeros(3)))
    assert (yaw, roll) == (0.0, 0.0)
    assert pitch == pytest.approx(np.pi / 2)


def test_look_at_the_own_place_is_refused():
    with pytest.raises(ValueError, match="target"):
        look_at(np.zeros((1, 3)), np.zeros(3))


def test_sphere_poses_without_jitter_look_at_the_origin():
    poses = Poses.sphere(30, radius=0.4, aim_jitter=0.0, generator=np.random.default_rng(0))
    np.testing.assert_allclose(np.linalg.norm(poses.positions, axis=1), 0.4)
    np.testing.assert_allclose(poses.rotations[:, :, 0], -poses.positions / 0.4, atol=1e-12)


@pytest.mark.parametrize("draw", [Poses.sphere, random_sphere_poses])
def test_jitter_has_its_standard_deviation_about_both_axes_and_no_roll(draw):
    poses = draw(4000, radius=1.0, aim_jitter=0.1, generator=np.random.default_rng(3))
    straight = look_at(poses.positions, np.zeros(3))
    forward = np.einsum("pji,pj->pi", straight, poses.rotations[:, :, 0])
    # 4000 draws give a standard deviation to about 1.1 %; four times that.
    assert np.std(np.arctan2(forward[:, 1], forward[:, 0])) == pytest.approx(0.1, rel=0.045)
    assert np.std(np.arcsin(forward[:, 2])) == pytest.approx(0.1, rel=0.045)
    np.testing.assert_allclose(poses.rotations[:, 2, 1], 0.0, atol=1e-12)


def test_random_poses_fill_the_sphere_and_follow_the_generator():
    one, two = (
        random_sphere_poses(2000, radius=2.0, aim_jitter=0.1, generator=np.random.default_rng(5))
        for _ in range(2)
    )
    np.testing.assert_array_equal(one.rotations, two.rotations)
    unit = one.positions / 2.0
    np.testing.assert_allclose(unit.T @ unit / 2000, np.eye(3) / 3, atol=0.03)


def test_a_cap_covers_its_area_evenly():
    axis, half = np.array([1.0, 2.0, -2.0]) / 3.0, np.radians(70.0)
    straight = {"aim_jitter": 0.0, "generator": np.random.default_rng(0)}
    poses = cap_poses(400, radius=0.5, axis=3.0 * axis, half_angle=half, **straight)
    np.testing.assert_allclose(np.linalg.norm(poses.positions, axis=1), 0.5)
    along = np.sort(poses.positions @ axis / 0.5)
    # equal areas are equal heights
    np.testing.assert_allclose(np.diff(along), (1 - np.cos(half)) / 400, rtol=1e-6)
    assert along[0] > np.cos(half)
    np.testing.assert_allclose(poses.positions.mean(axis=0) @ axis, 0.25 * (1 + np.cos(half)))
    np.testing.assert_allclose(poses.rotations[:, :, 0], -poses.positions / 0.5, atol=1e-12)


def test_random_poses_are_uniform_in_the_volume_of_their_cone():
    axis, half = np.array([0.0, 0.6, 0.8]), np.radians(60.0)
    poses = random_poses(
        4000,
        radius=(1.0, 2.0),
        axis=axis,
        half_angle=half,
        aim_jitter=0.0,
        generator=np.random.default_rng(0),
    )
    distance = np.linalg.norm(poses.positions, axis=1)
    along = poses.positions @ axis / distance
    # Shares of the volume and of the area are uniform from 0 to 1, and know nothing of each other.
    shares = np.stack([(distance**3 - 1) / 7, (1 - along) / (1 - np.cos(half))])
    for share in shares:
        assert (share.min() > 0, share.max() < 1) == (True, True)
        counts = np.histogram(share, bins=10, range=(0, 1))[0]
        np.testing.assert_allclose(counts, 400, atol=4 * np.sqrt(400))
    assert abs(np.corrcoef(shares)[0, 1]) < 4 / np.sqrt(4000)
    turn = np.arctan2(poses.positions @ [1.0, 0.0, 0.0], poses.positions @ [0.0, 0.8, -0.6])
    assert abs(np.exp(1j * turn).mean()) < 4 / np.sqrt(4000)
    np.testing.assert_allclose(
        poses.rotations[:, :, 0], -poses.positions / distance[:, None], atol=1e-12
    )


def test_indexing_gives_poses():
    poses = Poses.sphere(9, radius=1.0, aim_jitter=0.1, generator=np.random.default_rng(0))
    assert len(poses[3]) == 1
    np.testing.assert_array_equal(poses[3].rotations[0], poses.rotations[3])
    assert len(poses[2:5]) == 3
    np.testing.assert_array_equal(poses[np.array([7, 1])].positions, poses.positions[[7, 1]])


@pytest.mark.parametrize(
    ("positions", "rotations", "message"),
    [
        (np.zeros(3), np.eye(3)[None], r"positions have shape \(3,\)"),
        (np.zeros((2, 3)), np.eye(3)[None], "rotations have shape"),
        ([[0.4, 0, 0], [np.nan, 0, 0]], [np.eye(3)] * 2, r"1 of 2 poses \(1\) hold NaN"),
        (np.zeros((2, 3)), [np.eye(3), 2 * np.eye(3)], r"1 of 2 poses \(1\) are no rotations"),
        (np.zeros((1, 3)), [np.diag([1.0, 1.0, -1.0])], "are no rotations"),
    ],
)
def test_what_is_no_pose_is_refused(positions, rotations, message):
    with pytest.raises(InputError, match=message):
        Poses(positions, rotations)


def test_poses_that_look_at_a_target():
    poses = Poses.looking_at([[0.3, 0.0, 0.1], [0.0, -0.2, 0.1]], (0.0, 0.0, 0.1))
    np.testing.assert_allclose(poses.rotations[:, :, 0], [[-1, 0, 0], [0, 1, 0]], atol=1e-12)
    np.testing.assert_allclose(poses.rotations[:, :, 2], [[0, 0, 1]] * 2, atol=1e-12)
    with pytest.raises(InputError, match=r"1 of 1 poses \(0\) are the target itself"):
        Poses.looking_at([[0.0, 0.0, 0.0]])
    with pytest.raises(InputError, match=r"positions \(3,\) and target"):
        Poses.looking_at([0.0, 0.0, 1.0])


def test_table_is_in_degrees_in_any_order_of_columns(tmp_path):
    path = tmp_path / "poses.csv"
    path.write_bytes("\ufeffroll,x,y,z,yaw,pitch\r\n0, 1,2,3,90,30\r\n\r\n".encode())
    poses = Poses.read(path)
    np.testing.assert_array_equal(poses.positions, [[1, 2, 3]])
    np.testing.assert_allclose(poses.rotations[0, :, 0], [0, np.cos(np.pi / 6), -0.5], atol=1e-12)


@pytest.mark.parametrize(
    ("text", "match"),
    [
        ("", r"poses\.csv: holds no poses; expected a header line and one line per pose$"),
        (" ,\n\n", r"poses\.csv: holds no poses"),
        ("a,b\n1,2\n", r"poses\.csv:1: the header is 'a,b', expected x,y,z,yaw,pitch,roll$"),
        ("x,y,z,yaw,pitch\n1,2,3,4,5\n", r"poses\.csv:1: the header"),
        ("x,y,z,yaw,pitch,roll\n", "holds no poses"),
        ("x,y,z,yaw,pitch,roll\n0,0,0,0,0,0\n0,nan,0,0,0,0\n", r"poses\.csv:3: column y is 'nan'"),
        ("x,y,z,yaw,pitch,roll\n0,0,0,left,0,0\n", r"poses\.csv:2: column yaw is 'left'"),
        ("x,y,z,yaw,pitch,roll\n0,0,0,0,0\n", r"poses\.csv:2: 5 columns, expected 6"),
        ("x,y,z,yaw,pitch,roll\n0,0,0,0,0,inf\n", r"poses\.csv:2: column roll is 'inf'"),
        ('x,y,z,yaw,pitch,roll\n"0,0,0,0,0\n', "no CSV table"),
    ],
)
def test_faults_of_a_table_name_the_place(tmp_path, text, match):
    path = tmp_path / "poses.csv"
    path.write_text(text, encoding="utf-8")
    with pytest.raises(InputError, match=match):
        Poses.read(path)


def test_unreadable_tables_are_named(tmp_path):
    with pytest.raises(InputError, match="cannot be read"):
        Poses.read(tmp_path / "none.csv")
    (tmp_path / "latin.csv").write_bytes(b"x,y,z\xe4")
    with pytest.raises(InputError, match="UTF-8"):
        Poses.read(tmp_path / "latin.csv")


CENTRE = np.array([0.03, -0.02, 0.01])
RIGHT = Poses.looking_at(
    Poses.sphere(60, radius=0.4, generator=np.random.default_rng(1)).positions, CENTRE
)
YAW, PITCH, ROLL = euler_from_rotation(RIGHT.rotations)


def read_as(*angles):
    return Poses(RIGHT.positions, rotation_from_euler(*angles))


def test_heads_that_look_at_the_body_or_a_little_past_it_raise_no_question():
    np.testing.assert_allclose(off_axis(RIGHT, CENTRE), 0.0, atol=1e-6)
    assert aim_fault(RIGHT, CENTRE) == ""
    jittered = Poses.sphere(60, radius=0.4, aim_jitter=np.radians(25))
    assert aim_fault(jittered, CENTRE) == ""


@pytest.mark.parametrize(
    ("angles", "cause"),
    [
        ((np.radians(YAW), np.radians(PITCH), np.radians(ROLL)), "radians, and are read as deg"),
        ((PITCH, YAW, ROLL), "yaw and pitch are swapped"),
        ((YAW + np.pi, -PITCH, -ROLL), "the poses look the other way"),
        ((-YAW, PITCH, ROLL), "the sign of yaw is the opposite one"),
    ],
)
def test_the_mistake_is_named(angles, cause):
    fault = aim_fault(read_as(*angles), CENTRE)
    assert fault.startswith(("poses look away from the body", "poses look past the body"))
    assert cause in fault


def test_the_sign_of_pitch_is_named_where_poses_are_high():
    high = Poses.looking_at(RIGHT.positions[RIGHT.positions[:, 2] > 0.2], CENTRE)
    yaw, pitch, roll = euler_from_rotation(high.rotations)
    fault = aim_fault(Poses(high.positions, rotation_from_euler(yaw, -pitch, roll)), CENTRE)
    assert "sign of pitch is the opposite one" in fault


def test_poses_that_look_anywhere_are_told_without_a_cause():
    turns = np.random.default_rng(0).uniform(-3, 3, (3, 60))
    fault = aim_fault(read_as(*turns), CENTRE)
    assert "by " in fault
    assert "perhaps" not in fault
