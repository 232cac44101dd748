# SPDX-License-Identifier: MIT


import dataclasses

import numpy as np
import pytest

from sononerf.errors import InputError
from sononerf.geometry.directions import fibonacci_sphere
from sononerf.head.directivity import interpolation, unit_vectors
from sononerf.head.directivity_files import content_hash, read_csv, read_directivity, write_sofa
from tests.head.directivity.patterns import (
    FREQUENCY,
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


def test_unit_vectors_are_of_the_head_frame():
    wanted = [[1, 0, 0], [0, 1, 0], [0, 0, 1]]
    angles = np.radians([[0.0, 90.0, 0.0], [0.0, 0.0, 90.0]])
    np.testing.assert_allclose(unit_vectors(*angles), wanted, atol=1e-12)


def test_frequencies_outside_the_file_are_those_at_its_ends():
    known = pair()
    wanted = np.array([1e3, 30e3, 40e3, 80e3, 200e3])
    low, first, middle, last, high = np.moveaxis(known.at(wanted, known.gains), -1, 0)
    np.testing.assert_array_equal(low, first)
    np.testing.assert_array_equal(high, last)
    np.testing.assert_allclose(middle, known.gains[..., :2].mean(axis=-1))


def test_one_frequency_serves_all():
    known = pair()
    alone = dataclasses.replace(
        known, frequency=FREQUENCY[:1], gains=known.gains[..., :1], beam=None
    )
    found = alone.at(np.array([1.0, 1e5]), alone.gains)
    np.testing.assert_array_equal(found[..., 0], found[..., 1])


def spoilt(values, value):
    changed = values.copy()
    changed.flat[0] = value
    return changed


@pytest.mark.parametrize(
    ("changes", "said"),
    [
        (lambda d: {"gains": spoilt(d.gains, np.nan)}, "the gains hold NaN"),
        (lambda d: {"gains": spoilt(d.gains, -0.5)}, "the gains hold the negative value -0.5"),
        (lambda d: {"beam": spoilt(d.beam, -1.0)}, "emitter's gains hold the negative value"),
        (lambda d: {"gains": 0 * d.gains}, "the gains are all zero"),
        (lambda d: {"gains": d.gains[:, 1:]}, r"shape \(322, 3\), expected \(323, 3\)"),
        (lambda d: {"gains": d.gains[:0]}, "holds 0 receivers"),
        (lambda d: {"frequency": d.frequency[::-1]}, "do not ascend"),
        (lambda d: {"frequency": spoilt(d.frequency, np.inf)}, "frequencies hold NaN or infinite"),
        (lambda d: {"directions": 2 * d.directions}, "no unit vector"),
        (lambda d: {"places": d.places[:1]}, "states 1 places of 2 receivers"),
    ],
)
def test_what_is_not_allowed_is_refused(changes, said):
    known = pair()
    with pytest.raises(InputError, match=f"^made up: .*{said}"):
        dataclasses.replace(known, **changes(known))


def grid(azimuth, elevation):
    return unit_vectors(*np.radians(np.meshgrid(azimuth, elevation))).reshape(-1, 3)


def smooth(directions):
    return np.exp(directions @ np.array([0.9, 0.3, -0.3]))


GRIDS = {
    "whole": grid(np.arange(-180.0, 181.0, 5.0), np.arange(-90.0, 91.0, 5.0)),  # poles and seam
    "front": grid(np.arange(-90.0, 91.0, 5.0), np.arange(-90.0, 91.0, 5.0)),
    "patch": grid(np.arange(-40.0, 41.0, 5.0), np.arange(-30.0, 31.0, 5.0)),
    "uneven": grid(np.arange(-180.0, 180.0, 2.0), np.arange(-80.0, 81.0, 10.0)),
    "scattered": fibonacci_sphere(1000),
}


@pytest.mark.parametrize("known", GRIDS.values(), ids=GRIDS.keys())
def test_measured_directions_are_reproduced(known):
    np.testing.assert_allclose(interpolation(known, known) @ smooth(known), smooth(known), 1e-12)


@pytest.mark.parametrize("name", ["whole", "scattered", "uneven"])
def test_between_directions_values_are_near(name):
    known, wanted = GRIDS[name], fibonacci_sphere(3000)
    found = interpolation(known, wanted) @ smooth(known)
    np.testing.assert_allclose(found, smooth(wanted), rtol=0.02)


def test_order_and_rounding_of_directions_do_not_matter():
    known, wanted = GRIDS["front"], fibonacci_sphere(2000)
    order = np.random.default_rng(0).permutation(len(known))
    expected = interpolation(known, wanted) @ smooth(known)
    moved = known[order] + 1e-12
    np.testing.assert_allclose(interpolation(moved, wanted) @ smooth(moved), expected, atol=1e-9)


@pytest.mark.parametrize(("beyond_deg", "low", "high"), [(1, 1, 1), (7, 0.4, 0.7), (14, 0, 0)])
def test_outside_the_measured_area_values_fade_to_zero_over_10_degrees(beyond_deg, low, high):
    wanted = grid(np.array([40.0 + beyond_deg, -40.0 - beyond_deg]), np.array([0.0]))
    known = GRIDS["patch"]
    weight = interpolation(known, wanted).sum(axis=1)
    assert (weight >= low - 1e-9).all()
    assert (weight <= high + 1e-9).all()


def test_the_nearest_value_is_the_one_that_fades():
    known = GRIDS["patch"]
    only_left = np.where(known[:, 1] > 0.0, 1.0, 0.0)
    left, right = grid(np.array([45.0, -45.0]), np.array([0.0]))
    assert interpolation(known, left[None]) @ only_left > 0.4
    assert interpolation(known, right[None]) @ only_left == 0.0


@pytest.mark.parametrize("known", [GRIDS["patch"][:1], grid(np.arange(-90.0, 91.0, 5.0), [0.0])])
def test_directions_in_one_plane_count_for_what_is_near_them(known):
    weight = interpolation(known, np.array([[1.0, 0, 0], [0, 0, 1.0], known[0]])).sum(axis=1)
    assert weight[2] == pytest.approx(1.0)
    assert weight[1] == 0.0
    assert weight.max() <= 1.0 + 1e-12


def test_equal_directions_are_averaged():
    known = np.array([[1.0, 0, 0], [1.0, 0, 0], [0, 1.0, 0]])
    found = interpolation(known, known[:1]) @ np.array([1.0, 3.0, 9.0])
    np.testing.assert_allclose(found, [2.0])
