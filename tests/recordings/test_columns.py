# SPDX-License-Identifier: MIT
"""Tables of poses: units are stated in the names or the settings, and never guessed."""

from __future__ import annotations

import numpy as np
import pytest

from sononerf.errors import InputError
from sononerf.recordings.pose_tables import columns_of, read_table
from sononerf.settings.import_schema import ImportSettings

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
        ("x_ft\n1\n", "unknown unit 'ft'"),
        ("x_m,heigth\n1,2\n", "did you mean height?"),
        ("x_m,x_m\n1,2\n", "stands twice"),
        ("x_m,x_mm\n1,2\n", "stands twice"),
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
