# SPDX-License-Identifier: MIT


import numpy as np
import pytest

from sononerf.errors import InputError
from sononerf.head.directivity.directivity_files import (
    content_hash,
    read_csv,
    read_directivity,
    write_sofa,
)
from tests.head.directivity.patterns import (
    batslam_fields,
    pair,
    sononerf_fields,
    write_v5,
    write_v73,
)


def write_table(path):
    known = pair()
    x, y, z = known.directions.T
    angles = np.degrees([np.arctan2(y, x), np.arcsin(z)]).T
    lines = ["receiver,azimuth_deg,elevation_deg,frequency_hz,gain"]
    for name, gains in (("0", known.gains[0]), ("1", known.gains[1]), ("emitter", known.beam)):
        lines += [
            f"{name},{a:.9f},{e:.9f},{frequency:.9g},{gain:.17g}"
            for (a, e), row in zip(angles, gains, strict=True)
            for frequency, gain in zip(known.frequency, row, strict=True)
        ]
    path.write_text("\n".join(lines))


WRITERS = {
    "sofa": lambda path: write_sofa(path, pair()),
    "sononerf v5": lambda path: write_v5(path, sononerf_fields()),
    "sononerf v7.3": lambda path: write_v73(path, sononerf_fields()),
    "batslam v5": lambda path: write_v5(path, batslam_fields()),
    "batslam v7.3": lambda path: write_v73(path, batslam_fields()),
    "table": write_table,
}


@pytest.mark.parametrize("write", WRITERS.values(), ids=WRITERS.keys())
def test_formats_are_told_apart_by_content(tmp_path, write):
    path = tmp_path / "any.dat"
    write(path)
    assert len(read_directivity(path).gains) == 2


def test_a_file_is_read_once_until_it_changes(tmp_path):
    path = tmp_path / "a.sofa"
    write_sofa(path, pair())
    first, hashed = read_directivity(path), content_hash(path)
    assert read_directivity(path) is first
    write_sofa(path, pair(beam=False))
    assert read_directivity(path).beam is None
    assert content_hash(path) != hashed


def test_what_cannot_be_read(tmp_path):
    with pytest.raises(InputError, match="no such file"):
        read_directivity(tmp_path / "a.sofa")
    with pytest.raises(InputError, match="cannot be read"):
        read_directivity(tmp_path)
    (tmp_path / "empty").touch()
    with pytest.raises(InputError, match="columns none"):
        read_directivity(tmp_path / "empty")
    assert [path.name for path in tmp_path.iterdir()] == ["empty"]


HEAD = "azimuth_deg,elevation_deg,frequency_hz,gain\n"
LINES = [f"{a},{e},{f},{1 / (1 + abs(a) + f / 1e4)}" for f in (4e4, 5e4) for e in (0, 10)
         for a in (-20, 0, 20)]  # fmt: skip


def write(path, text):
    path.write_text(text, encoding="utf-8")
    return path


def test_a_table_of_gains_in_any_order(tmp_path):
    found = read_csv(write(tmp_path / "a.csv", HEAD + "\n".join(LINES[::-1])))
    assert found.gains.shape == (1, 6, 2)
    np.testing.assert_array_equal(found.frequency, [4e4, 5e4])
    left = np.radians(20.0)
    row = np.argmin(np.linalg.norm(found.directions - [np.cos(left), np.sin(left), 0], axis=1))
    np.testing.assert_allclose(found.gains[0, row], [1 / 25, 1 / 26])
    assert found.beam is None
    assert found.places is None


def test_receivers_emitter_and_decibels(tmp_path):
    text = "Receiver, azimuth_deg, elevation_deg, frequency_hz, gain_db\n"
    for receiver, level in (("1", -20), ("emitter", -6), ("0", 0)):
        text += f"{receiver},0,0,40000,{level}\n{receiver},90,0,40000,{level - 20}\n"
    found = read_csv(write(tmp_path / "a.csv", text))
    np.testing.assert_allclose(found.gains[:, 0, 0], [1.0, 0.1])
    np.testing.assert_allclose(found.beam[:, 0], [10**-0.3, 10**-1.3])


@pytest.mark.parametrize(
    ("text", "said"),
    [
        ("", "columns none; expected azimuth_deg"),
        ("azimuth_deg,elevation_deg,gain\n0,0,1\n", "expected azimuth_deg, elevation_deg, freq"),
        (HEAD.replace("gain", "gain,gain_db") + "0,0,1,1,0\n", "one of gain and gain_db"),
        (HEAD, "holds no gains"),
        (HEAD + "0,0,4e4,1\n0,0,4e4\n", "4 columns but 3 were found at row 2"),
        (HEAD + "0,0,4e4,loud\n", "could not convert string 'loud' to float64 at row 0"),
        (HEAD + "0,0,4e4,nan\n", "NaN or infinite"),
        (HEAD + "0,91,4e4,1\n", "an elevation is beyond 90 degrees"),
        (HEAD + "0,0,4e4,-1\n", "negative value -1"),
        (HEAD + "\n".join(LINES[:-1]), "has 0 gains at azimuth 20, elevation 10, 50000 Hz"),
        (HEAD + "\n".join([*LINES, LINES[0]]), "has 2 gains at azimuth -20, elevation 0, 40000 Hz"),
        ("receiver," + HEAD + "1,0,0,4e4,1\n", "the receivers are 1; expected 0, 1"),
        ("receiver," + HEAD + "left,0,0,4e4,1\n", "the receivers are left; expected 0, 1"),
    ],
)
def test_a_bad_table_is_one_line(tmp_path, text, said):
    path = write(tmp_path / "a.csv", text)
    with pytest.raises(InputError) as raised:
        read_csv(path)
    assert said in str(raised.value)
    assert str(raised.value).startswith(f"{path}: ")
    assert "\n" not in str(raised.value)


def test_what_is_no_text_is_refused(tmp_path):
    path = tmp_path / "a.csv"
    path.write_bytes(bytes(range(256)) * 4)
    with pytest.raises(InputError, match=r"no SOFA file, .* and no table of text"):
        read_csv(path)
