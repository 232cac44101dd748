# SPDX-License-Identifier: MIT
"""Tables of poses: units are stated in the names or the settings, and never guessed."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from sononerf.errors import InputError, SettingsError
from sononerf.geometry.poses import rotation_from_euler
from sononerf.recordings.pose_tables import (
    columns_of,
    frame_matrices,
    read_table,
    to_poses,
    turntable_poses,
)
from sononerf.settings.sections import ImportSettings

PLAIN = ImportSettings()


@pytest.fixture
def table(tmp_path):
    """Write a table and return its path."""

    def write(text):
        path = tmp_path / "poses.csv"
        path.write_bytes(text if isinstance(text, bytes) else text.encode())
        return path

    return write


def test_names_say_units(table):
    columns = read_table(
        table("file,x_mm,y_cm,z_m,yaw_deg,pitch_rad,time_ms,split\na.wav,1,2,3,180,0.5,4,val\n"),
        PLAIN,
    )
    found = {name: float(values[0]) for name, values in columns.values.items()}
    assert found == pytest.approx(
        {"x": 1e-3, "y": 0.02, "z": 3.0, "yaw": np.pi, "pitch": 0.5, "time": 4e-3}
    )
    assert columns.texts == {"file": ["a.wav"], "split": ["val"]}
    assert columns.split().tolist() == [1]
    assert (len(columns), columns.units["x"], columns.units["yaw"]) == (1, "mm", "deg")


@pytest.mark.parametrize("separator", [",", ";", "\t"])
def test_settings_say_units_of_plain_names(table, separator):
    text = "x,y,z,yaw,pitch,roll\n1,2,3,90,0,0\n".replace(",", separator)
    columns = read_table(table("\ufeff" + text), ImportSettings(length="mm", angle="deg"))
    assert columns.values["x"][0] == pytest.approx(1e-3)
    assert columns.values["yaw"][0] == pytest.approx(np.pi / 2)


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("x,y,z\n1,2,3\n", "column x has no unit; name it x_m or set import.length"),
        ("x_m,y_m,z_m,yaw\n1,2,3,4\n", "column yaw has no unit; name it yaw_deg"),
        ("x_yd\n1\n", "unknown unit 'yd'"),
        ("x_m,heigth\n1,2\n", "did you mean height?"),
        ("x_m,x_m\n1,2\n", "duplicate column"),
        ("x_m,x_mm\n1,2\n", "duplicate column"),
        ("x_m,y_m\n1\n", ":2: 1 columns, expected 2"),
        ("x_m\n1\nnan\n", ":3: column x_m is 'nan'"),
        ("x_m\n1,5\n", ":2: 2 columns"),
        ("x_m\n", "holds no poses"),
        ("", "holds no poses"),
        (b"x_m\n\xff\n", "not UTF-8"),
        ('x_m\n"1\n', "no CSV table"),
    ],
)
def test_a_fault_is_one_line_with_its_place(table, text, words):
    path = table(text)
    with pytest.raises(InputError) as caught:
        read_table(path, PLAIN)
    assert words in str(caught.value)
    assert str(path) in str(caught.value)
    assert "\n" not in str(caught.value)


def test_a_missing_table_is_told(tmp_path):
    with pytest.raises(InputError, match="cannot be read"):
        read_table(tmp_path / "poses.csv", PLAIN)


def test_an_unknown_split_is_told(table):
    columns = read_table(table("x_m,split\n1,train\n2,held\n"), PLAIN)
    with pytest.raises(InputError, match="row 2 is 'held', expected train, val, test"):
        columns.split()


def test_rows_are_chosen_in_all_columns():
    columns = columns_of(
        "t",
        {"x_m": [1.0, 2.0, 3.0]},
        PLAIN,
        texts={"file": ["a", "b", "c"]},
        rotation=np.stack([np.eye(3)] * 3),
    )
    chosen = columns.take([2, 0])
    assert chosen.values["x"].tolist() == [3.0, 1.0]
    assert chosen.texts["file"] == ["c", "a"]
    assert chosen.rotation.shape == (2, 3, 3)
    assert chosen.split() is None


def test_numbers_of_arrays_are_finite_too():
    with pytest.raises(InputError, match="column x_m of row 2 is no finite number"):
        columns_of("t", {"x_m": [1.0, np.inf]}, PLAIN)


# A head at 1 m east, 2 m north, 3 m up that looks north and 30 degrees down, right ear down a bit.
PLACE = np.array([1.0, 2.0, 3.0])
LOOK = rotation_from_euler(np.pi / 2, np.pi / 6, 0.2)


def poses_of(given, rotation=None, **settings):
    wanted = ImportSettings(**settings)
    columns = columns_of("t", given, wanted, rotation=rotation)
    return to_poses(columns, wanted)


def assert_ours(poses):
    np.testing.assert_allclose(poses.positions, PLACE[None], atol=1e-12)
    np.testing.assert_allclose(poses.rotations, LOOK[None], atol=1e-12)


def test_our_own_frame_stays():
    angles = {"yaw_deg": [90.0], "pitch_deg": [30.0], "roll_rad": [0.2]}
    assert_ours(poses_of({"x_m": [1.0], "y_m": [2.0], "z_mm": [3000.0], **angles}))


def test_north_east_down():
    # Heading 0 is north; pitch is positive when looking up; roll is positive right wing down.
    angles = {"yaw_deg": [0.0], "pitch_deg": [-30.0], "roll_rad": [0.2]}
    assert_ours(poses_of({"x_m": [2.0], "y_m": [1.0], "z_m": [-3.0], **angles}, frame="ned"))


def test_a_camera_looks_along_its_z():
    # Right, down and forward of the camera in the world, as columns.
    camera = np.stack([-LOOK[:, 1], -LOOK[:, 2], LOOK[:, 0]], axis=1)
    places = {"x_m": [1.0], "y_m": [2.0], "z_m": [3.0]}
    assert_ours(poses_of(places, rotation=camera[None], frame="camera"))


def test_a_left_handed_frame_of_ones_own():
    # x east, y south, z up; the head's y points right. Turns go the other way round z and x.
    angles = {"yaw_deg": [-90.0], "pitch_deg": [30.0], "roll_rad": [-0.2]}
    given = {"x_m": [1.0], "y_m": [-2.0], "z_m": [3.0], **angles}
    axes = [[1, 0, 0], [0, -1, 0], [0, 0, 1]]
    assert_ours(poses_of(given, frame="own", axes=axes))


def test_pitch_may_be_positive_upward():
    angles = {"yaw_deg": [90.0], "pitch_deg": [-30.0], "roll_rad": [0.2]}
    given = {"x_m": [1.0], "y_m": [2.0], "z_m": [3.0], **angles}
    assert_ours(poses_of(given, positive_pitch="up"))
    down = {**given, "pitch_deg": [30.0]}
    assert_ours(poses_of(down, positive_pitch="down"))


def test_a_quaternion():
    x, y, z, w = Rotation.from_matrix(LOOK).as_quat()
    parts = {"qw": [w], "qx": [x], "qy": [y], "qz": [z]}
    assert_ours(poses_of({"x_m": [1.0], "y_m": [2.0], "z_m": [3.0], **parts}))


def test_without_orientation_all_look_at_one_place():
    poses = poses_of({"x_m": [1.0, 0.0], "y_m": [0.0, 0.0], "z_m": [0.0, 1.0]}, look_at=[0, 0, 0])
    np.testing.assert_allclose(poses.rotations[:, :, 0], [[-1, 0, 0], [0, 0, -1]], atol=1e-12)


def test_a_turntable_turns_the_object_and_so_the_sensor_goes_back():
    quarter, height = np.array([0.0, np.pi / 2]), np.array([0.1, 0.1])
    poses = turntable_poses(quarter, height, radius=0.5, clockwise=False)
    np.testing.assert_allclose(poses.positions, [[0.5, 0, 0.1], [0, -0.5, 0.1]], atol=1e-12)
    np.testing.assert_allclose(poses.rotations[:, :, 0], [[-1, 0, 0], [0, 1, 0]], atol=1e-12)
    given = {"angle_deg": [0.0, 90.0], "height_mm": [50.0, 50.0]}
    table = {"radius": 0.5, "turns": "clockwise", "height": 0.05}
    other = poses_of(given, turntable=table)
    np.testing.assert_allclose(other.positions, [[0.5, 0, 0.1], [0, 0.5, 0.1]], atol=1e-12)


@pytest.mark.parametrize(
    ("given", "settings", "words"),
    [
        ({"x_m": [1.0]}, {}, "column y is missing"),
        ({"angle_deg": [1.0]}, {}, "set import.turntable.radius"),
        ({"x_m": [1.0]}, {"turntable": {"radius": 1}}, "column angle is missing"),
        ({"x_m": [1.0], "y_m": [1.0], "z_m": [1.0]}, {}, "no orientation; add columns yaw"),
        ({"x_m": [0.0], "y_m": [0.0], "z_m": [0.0]}, {"look_at": [0, 0, 0]}, "import.look_at"),
        (
            {"x_m": [1.0], "y_m": [1.0], "z_m": [1.0], "yaw_deg": [1.0], "roll_deg": [0.0]},
            {},
            "column pitch is missing",
        ),
        (
            {"x_m": [1.0], "y_m": [1.0], "z_m": [1.0], "yaw_deg": [1.0], "qw": [1.0]},
            {},
            "holds both yaw, pitch, roll and qw",
        ),
        (
            {"x_m": [1], "y_m": [1], "z_m": [1], "qw": [2], "qx": [0], "qy": [0], "qz": [0]},
            {},
            "quaternion of row 1 has length 2",
        ),
    ],
)
def test_what_is_missing_or_double_is_told(given, settings, words):
    with pytest.raises(InputError, match=words):
        poses_of(given, **settings)


@pytest.mark.parametrize(
    ("rotation", "words"),
    [(np.diag([1.0, -1.0, 1.0]), "mirror image"), (np.ones((3, 3)), "no rotation matrix")],
)
def test_a_matrix_that_is_no_rotation_is_told(rotation, words):
    with pytest.raises(InputError, match=words):
        poses_of({"x_m": [1.0], "y_m": [1.0], "z_m": [1.0]}, rotation=rotation[None])


def test_own_axes_are_orthogonal_and_of_one_hand():
    mirror, unit = [[1, 0, 0], [0, -1, 0], [0, 0, 1]], [[1, 0, 0], [0, 1, 0], [0, 0, 1]]
    with pytest.raises(SettingsError, match=r"import\.axes: its rows"):
        frame_matrices(ImportSettings(frame="own", axes=[[1, 1, 0], [0, 1, 0], [0, 0, 1]]))
    with pytest.raises(SettingsError, match="left-handed and the other is not"):
        frame_matrices(ImportSettings(frame="own", axes=mirror, head_axes=unit))
