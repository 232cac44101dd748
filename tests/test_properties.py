# SPDX-License-Identifier: MIT
"""What holds for whatever is given, and not only for the examples of the other tests."""

from __future__ import annotations

import csv
import math

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from hypothesis.extra import numpy as arrays
from scipy.spatial.transform import Rotation

import sononerf as sn
from sononerf.echoes.detection import onsets, threshold_levels
from sononerf.errors import SonoNerfError
from sononerf.geometry.poses import Poses, euler_from_rotation, rotation_from_euler
from sononerf.head.front_end import compress, expand
from sononerf.recordings.pose_tables import columns_of, read_table, to_poses
from sononerf.settings.loading import apply_override, dump_yaml, load_settings
from sononerf.settings.schema import Settings
from sononerf.settings.sections import ImportSettings
from sononerf.storage import commit, commit_json, read_json

settings.register_profile("suite", max_examples=40, deadline=None, derandomize=True, database=None,
                          suppress_health_check=[HealthCheck.function_scoped_fixture])  # fmt: skip
settings.load_profile("suite")

ANGLE = st.floats(-math.pi, math.pi)
PLACE = st.tuples(*[st.floats(-10.0, 10.0)] * 3)
QUATERNION = arrays.arrays(float, 4, elements=st.floats(-1.0, 1.0)).filter(
    lambda parts: np.linalg.norm(parts) > 0.1
)
POSE = st.tuples(PLACE, QUATERNION)
TEXT = st.text(st.characters(codec="utf-8"), max_size=30)


def poses_of(given):
    places, turns = zip(*given, strict=True)
    return Poses(np.array(places), Rotation.from_quat(np.array(turns)).as_matrix())


def refusal(call, *arguments):
    """The message of an error of ours; None if there is none. Other errors are not caught."""
    try:
        call(*arguments)
    except SonoNerfError as error:
        return str(error)
    return None


# Poses, units and frames


@given(ANGLE, st.floats(-math.pi / 2, math.pi / 2), ANGLE)
def test_angles_are_scipys_and_give_their_rotation_again(yaw, pitch, roll):
    rotation = rotation_from_euler(yaw, pitch, roll)
    expected = Rotation.from_euler("ZYX", [yaw, pitch, roll]).as_matrix()
    np.testing.assert_allclose(rotation, expected, atol=1e-12)
    again = rotation_from_euler(*euler_from_rotation(rotation))
    np.testing.assert_allclose(again, rotation, atol=1e-7)  # near the poles cosines are flat
    assert math.copysign(1.0, rotation[2, 0]) == -math.copysign(1.0, math.sin(pitch))


@given(st.lists(POSE, min_size=1, max_size=5))
def test_a_table_of_poses_comes_back(tmp_path, given):
    poses = poses_of(given)
    (tmp_path / "poses.csv").write_text(poses.table(), encoding="utf-8")
    found = Poses.read(tmp_path / "poses.csv")
    np.testing.assert_array_equal(found.positions, poses.positions)
    np.testing.assert_allclose(found.rotations, poses.rotations, atol=1e-7)


TO_WORLD = {"enu": np.eye(3), "ned": np.array([[0, 1, 0], [1, 0, 0], [0, 0, -1.0]])}
TO_HEAD = {"enu": np.eye(3), "ned": np.diag([1.0, -1.0, -1.0])}


@given(POSE, st.sampled_from(["enu", "ned"]), st.sampled_from(["m", "cm", "mm"]),
       st.sampled_from(["deg", "rad"]), st.booleans())  # fmt: skip
def test_a_pose_is_the_same_in_any_unit_and_frame(given, frame, length, angle, in_names):
    pose = poses_of([given])
    place = TO_WORLD[frame].T @ pose.positions[0] * {"m": 1.0, "cm": 100.0, "mm": 1000.0}[length]
    turn = euler_from_rotation(TO_WORLD[frame].T @ pose.rotations[0] @ TO_HEAD[frame])
    turn = np.degrees(turn) if angle == "deg" else np.array(turn)
    units = {"x": length, "y": length, "z": length, "yaw": angle, "pitch": angle, "roll": angle}
    numbers = zip(units, [*place, *turn], strict=True)
    columns = {f"{n}_{units[n]}" if in_names else n: [value] for n, value in numbers}
    stated = {} if in_names else {"length": length, "angle": angle}
    wanted = ImportSettings(frame=frame, **stated)
    found = to_poses(columns_of("table", columns, wanted), wanted)
    np.testing.assert_allclose(found.positions, pose.positions, atol=1e-12)
    np.testing.assert_allclose(found.rotations, pose.rotations, atol=1e-7)


# Settings and tables


@given(
    st.fixed_dictionaries(
        {},
        optional={
            "fit": st.fixed_dictionaries(
                {},
                optional={
                    "epochs": st.integers(1, 10**6),
                    "learning_rate": st.floats(1e-9, 1.0),
                    "batch_frequencies": st.integers(1, 99) | st.just("all"),
                },
            ),
            "poses": st.fixed_dictionaries(
                {"axis": PLACE.filter(lambda axis: np.abs(axis).max() > 0.1)}
            ),
            "scene": st.fixed_dictionaries(
                {"name": st.just("sphere")}, optional={"options": st.dictionaries(TEXT, TEXT)}
            ),
            "noise": st.fixed_dictionaries({"snr_db": st.none() | st.floats(-100.0, 100.0)}),
        },
    )
)
def test_settings_that_are_written_are_read_again(tmp_path, data):
    wanted = Settings.model_validate({"scene": {"name": "sphere"}, **data})
    (tmp_path / "a.yaml").write_text(dump_yaml(wanted), encoding="utf-8")
    assert load_settings(tmp_path / "a.yaml") == wanted


KEY = st.sampled_from(["", "scene", "scene.name", "fit.epochs", "ears.left", "poses", "call.file"])


@given(KEY | TEXT, TEXT | st.recursive(TEXT, lambda inner: inner.map("[{}]".format)))
def test_an_assignment_is_taken_or_refused(key, value):
    said = refusal(apply_override, {"scene": {"name": "sphere"}}, f"{key}={value}")
    assert said is None or said.strip()


@given(st.lists(st.lists(TEXT, max_size=7), max_size=4), st.binary(max_size=3))
def test_a_table_is_read_or_refused_with_its_name(tmp_path, rows, junk):
    path = tmp_path / "poses.csv"
    with path.open("w", encoding="utf-8", newline="") as file:
        csv.writer(file).writerows([["x_m", "y_m", "z_m"], *rows])
    path.write_bytes(path.read_bytes() + junk)
    for read in (Poses.read, lambda path: read_table(path, ImportSettings())):
        said = refusal(read, path)
        assert said is None or (str(path) in said and "\n" not in said)


# Levels and onsets


@given(
    arrays.arrays(float, st.integers(1, 9), elements=st.floats(0.0, 1e6)),
    st.floats(1e-9, 1e3),
    st.floats(1e-3, 1e3),
)
def test_levels_know_their_magnitude_and_no_unit(magnitude, reference, gain):
    level = compress(magnitude, reference)
    np.testing.assert_allclose(expand(level, reference), magnitude, rtol=1e-9, atol=1e-9)
    np.testing.assert_allclose(compress(gain * magnitude, gain * reference), level, rtol=1e-9)
    assert (np.diff(compress(np.sort(magnitude), reference)) >= 0.0).all()


WINDOW = np.hamming(33) ** 2
ROWS, SLICES = 30, 400


@given(st.integers(-80, 80), st.floats(-20.0, 20.0), st.integers(0, 9))
def test_onsets_move_with_their_echoes_and_know_no_gain(slices, gain, seed):
    generator = np.random.default_rng(seed)
    power = 1e-5 * generator.gamma(4.0, 0.25, (ROWS, SLICES))
    for row, first in zip(power, generator.integers(130, 220, ROWS), strict=True):
        row[first : first + 33] += WINDOW

    def onsets_of(power):
        return onsets(power, threshold_levels(power, 4.0), WINDOW, 1.0)

    found = onsets_of(power)
    assert np.isfinite(found).all()
    np.testing.assert_allclose(onsets_of(10.0**gain * power), found, rtol=1e-9)
    np.testing.assert_allclose(onsets_of(np.roll(power, slices, axis=1)), found + slices, atol=0.01)


# Storage


@given(st.binary(max_size=200), st.binary(max_size=200), st.integers(0, 200))
def test_a_file_is_the_old_or_the_new_one(tmp_path, old, new, written):
    path = tmp_path / "file"
    commit(path, lambda file: file.write(old))

    def stopped(file):
        file.write(new[:written])
        raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        commit(path, stopped)
    assert path.read_bytes() == old
    commit(path, lambda file: file.write(new))
    assert path.read_bytes() == new
    assert [file.name for file in tmp_path.iterdir()] == ["file"]


JSON = st.recursive(
    st.none() | st.booleans() | st.integers(-(2**60), 2**60) | st.floats(allow_nan=False,
    allow_infinity=False) | TEXT,
    lambda inner: st.lists(inner, max_size=4) | st.dictionaries(TEXT, inner, max_size=4),
    max_leaves=12,
)  # fmt: skip


@given(st.dictionaries(TEXT, JSON))
def test_data_of_a_json_file_come_back(tmp_path, data):
    commit_json(tmp_path / "a.json", data)
    assert read_json(tmp_path / "a.json") == data


# A whole reconstruction


def reconstruction(scale):
    """The surface of a sphere, its head and its poses, all lengths times a number."""
    places = {"emitter": (0, 0, 0), "receivers": [(0, 0.01 * scale, 0), (0, -0.01 * scale, 0)]}
    head = sn.Head(
        ears={**places, "directivity": "omnidirectional", "beam_radius": 0},
        air={"relative_humidity": 0.0, "pressure_pa": 200_000.0},
        spectrogram={
            "sampling_rate": 1e6 / scale,
            "frequency_min": 40e3 / scale,
            "frequency_max": 80e3 / scale,
            "range_min": 0.2 * scale,
            "range_max": 0.3 * scale,
        },
    )
    poses = sn.Poses.sphere(40, radius=0.25 * scale, aim_jitter=0.0)
    emitters, receivers = head.places(poses.positions, poses.rotations)
    heights = np.linalg.norm(receivers, axis=-1)
    path = np.linalg.norm(emitters, axis=-1)[:, None] + heights - 2 * 0.02 * scale
    apart = (head.range - path[..., None] / 2) / scale
    heard = np.exp(-((apart / 0.002) ** 2))[..., None] * np.ones(len(head.frequency))
    surface = sn.reconstruct(sn.Echoes.from_arrays(heard, poses, head))
    return np.linalg.norm(surface.mesh.vertices, axis=1) / scale


@pytest.mark.parametrize("scale", [3.0])
def test_a_reconstruction_knows_no_length(scale):
    plain, scaled = reconstruction(1.0), reconstruction(scale)
    assert np.median(plain) == pytest.approx(0.02, abs=0.003)  # half a range resolution
    np.testing.assert_allclose(np.quantile(scaled, [0.1, 0.5, 0.9]),
                               np.quantile(plain, [0.1, 0.5, 0.9]), atol=3e-4)  # fmt: skip
