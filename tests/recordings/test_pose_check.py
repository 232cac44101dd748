# SPDX-License-Identifier: MIT
"""Thirty seeded distortions are named rightly, and thirty clean sets raise no alarm."""

from __future__ import annotations

import json
import re
from pathlib import Path

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from sononerf.errors import InputError
from sononerf.geometry.poses import Poses
from sononerf.recordings.pose_check import alternatives, check_poses, mirrored, shifted
from sononerf.recordings.pose_tables import Columns, to_poses
from sononerf.recordings.ranges import predict_ranges
from sononerf.recordings.recording import Recording, channels_of, check_channels, faults_of_channels
from sononerf.settings.sections import LENGTHS, ImportSettings
from tests.recordings.bodies import EARS, EMITTER, body, first_echoes, poses_of, table

RESOLUTION = 0.0058  # m, of the default analysis
PLAIN = ImportSettings()
KINDS = ("sphere", "volume", "cap")
ORDERS = {"yxz": "yxz", "zyx": "zyx", "xzy": "xzy", "yzx": "zxy", "zxy": "yzx"}
"""Where the columns were moved, and the name of how they go back."""


def few(seeds, often):
    """Return the seeds; those after the first ones are for the long tests."""
    return [seed if seed < often else pytest.param(seed, marks=pytest.mark.slow) for seed in seeds]


def scaled(columns, names, factor):
    values = {**columns.values, **{name: factor * columns.values[name] for name in names}}
    return Columns("t", values, {}, None, columns.units)


def poses_parts(poses):
    return poses.positions, poses.rotations


def verdict(columns, first, *, ears=EARS, settings=PLAIN):
    return check_poses(
        first,
        to_poses(columns, settings),
        alternatives(columns, settings) | shifted(columns, np.arange(len(columns)), settings),
        emitter=EMITTER,
        receivers=ears,
        resolution=RESOLUTION,
    )


@pytest.mark.parametrize("seed", few(range(30), 8))
def test_clean_sets_raise_no_alarm(seed):
    rng = np.random.default_rng(seed)
    poses = poses_of(rng, (*KINDS, "table")[seed % 4])
    found = verdict(table(poses), first_echoes(rng, poses, body(rng)))
    assert (found.name, found.message) == ("", "")


FAULTS = (
    "left-handed frame",
    "degrees for radians",
    "radians for degrees",
    "millimetres for metres",
    "metres for millimetres",
    "swapped axes",
    "time offset",
    "reversed turntable",
)
CASES = [
    pytest.param(FAULTS[n % len(FAULTS)], n, marks=[pytest.mark.slow] if n >= 8 else [])
    for n in range(30)
]


@pytest.mark.parametrize(("fault", "seed"), CASES)
def test_distortions_are_named(fault, seed):
    rng = np.random.default_rng(100 + seed)
    kind = KINDS[rng.integers(2 if fault == "time offset" else 3)]
    poses = poses_of(rng, "table" if fault == "reversed turntable" else kind)
    first = first_echoes(rng, poses, body(rng))
    columns, expected = table(poses), fault
    if fault in ("left-handed frame", "reversed turntable"):
        columns = table(mirrored(poses))
    elif fault == "degrees for radians":
        columns = scaled(table(poses, "rad"), ("yaw", "pitch", "roll"), 180 / np.pi)
    elif fault == "radians for degrees":
        columns = scaled(columns, ("yaw", "pitch", "roll"), np.pi / 180)
    elif fault == "swapped axes":
        order = list(ORDERS)[rng.integers(5)]
        moved = {name: columns.values[old] for name, old in zip("xyz", order, strict=True)}
        columns = Columns("t", {**columns.values, **moved}, {}, None, columns.units)
        expected = f"swapped axes, {ORDERS[order]} for xyz"
    elif fault == "time offset":
        first = first + rng.uniform(0.1, 0.3)
    else:
        columns = scaled(columns, "xyz", 1000 if fault.startswith("milli") else 0.001)
    found = verdict(columns, first)
    assert found.name == expected
    assert found.message
    assert "\n" not in found.message


@pytest.mark.parametrize("seed", few(range(6), 2))
@pytest.mark.parametrize("what", ["rotations", "poses"])
def test_rotations_from_world_to_head_are_named_and_the_setting_mends_them(seed, what):
    rng = np.random.default_rng(500 + seed)
    poses = poses_of(rng, KINDS[seed % 3])
    first = first_echoes(rng, poses, body(rng))
    rotation, places = poses.rotations.transpose(0, 2, 1), poses.positions
    if what == "poses":
        places = -np.einsum("pij,pj->pi", rotation, places)
    columns = Columns("t", dict(zip("xyz", places.T, strict=True)), {}, rotation, {"x": "m"})
    assert f"import.inverse={what}" in verdict(columns, first).message
    mended = ImportSettings(inverse=what)
    np.testing.assert_allclose(to_poses(columns, mended).positions, poses.positions, atol=1e-12)
    assert verdict(columns, first, settings=mended).message == ""


CAMERA = np.array([[0.0, -1.0, 0.0], [0.0, 0.0, 1.0], [-1.0, 0.0, 0.0]])
"""Axes of a camera of OpenGL (x right, y up, z back) in the head's."""


@pytest.mark.parametrize("seed", few(range(6), 2))
@pytest.mark.parametrize("kind", ["right-handed", "left-handed"])
def test_other_axes_of_the_head_are_named_and_the_settings_mend_them(seed, kind):
    rng = np.random.default_rng(700 + seed)
    true = poses_of(rng, KINDS[seed % 3])
    first = first_echoes(rng, true, body(rng))
    poses = true if kind == "right-handed" else mirrored(true)
    rotation = poses.rotations @ CAMERA.T
    columns = Columns(
        "t", dict(zip("xyz", poses.positions.T, strict=True)), {}, rotation, {"x": "m"}
    )
    message = verdict(columns, first).message
    advised = [
        ImportSettings.model_validate({"frame": "own", "axes": axes, "head_axes": head_axes})
        for axes, head_axes in re.findall(r"import.axes=(\S+) import.head_axes=([^\s)]+)", message)
        for axes, head_axes in [(json.loads(axes), json.loads(head_axes))]
    ]
    # Ears in one plane do not tell up from down, and so no mirrored world from a true one.
    mended = [to_poses(columns, settings) for settings in advised]
    assert any(np.allclose(one.rotations, true.rotations, atol=1e-5) for one in mended)
    assert verdict(columns, first, settings=advised[0]).message == ""


@pytest.mark.parametrize("seed", few(range(6), 2))
def test_angles_in_the_other_order_are_named_and_the_setting_mends_them(seed):
    rng = np.random.default_rng(800 + seed)
    poses = poses_of(rng, KINDS[seed % 3])
    first = first_echoes(rng, poses, body(rng))
    roll, pitch, yaw = Rotation.from_matrix(poses.rotations).as_euler("XYZ").T
    columns = table(poses)
    columns = Columns(
        "t", columns.values | {"yaw": yaw, "pitch": pitch, "roll": roll}, {}, None, columns.units
    )
    assert "import.euler=xyz" in verdict(columns, first).message
    mended = ImportSettings(euler="xyz")
    np.testing.assert_allclose(to_poses(columns, mended).rotations, poses.rotations, atol=1e-12)
    assert verdict(columns, first, settings=mended).message == ""


@pytest.mark.parametrize("seed", few(range(6), 2))
def test_a_compass_heading_is_named(seed):
    rng = np.random.default_rng(900 + seed)
    poses = poses_of(rng, KINDS[seed % 3])
    first = first_echoes(rng, poses, body(rng))
    columns = table(poses)
    values = {**columns.values, "yaw": np.pi / 2.0 - columns.values["yaw"]}
    columns = Columns("t", values, {}, None, columns.units)
    assert verdict(columns, first).name == "compass heading"


@pytest.mark.parametrize("seed", few(range(6), 3))
@pytest.mark.parametrize("units", ["in for cm", "cm for mm", "ft for m", "mm for cm"])
def test_lengths_of_another_unit_are_named(seed, units):
    true, stated = units.split(" for ")
    rng = np.random.default_rng(600 + seed)
    # Poses at one distance that lie too far apart fit a large body.
    far = LENGTHS[true] < LENGTHS[stated]
    poses = poses_of(rng, "volume" if far or seed % 2 else "sphere")
    first = first_echoes(rng, poses, body(rng))
    columns = scaled(table(poses), "xyz", LENGTHS[stated] / LENGTHS[true])
    columns = Columns("t", columns.values, {}, None, {**columns.units, "x": stated})
    assert f"in {true}, not in {stated}" in verdict(columns, first).message


@pytest.mark.parametrize("seed", few(range(12), 3))
@pytest.mark.parametrize(("step", "name"), [(1, "the row after"), (-1, "the row before")])
def test_pings_off_by_one_are_named(seed, step, name):
    rng = np.random.default_rng(200 + seed)
    poses = poses_of(rng, KINDS[seed % 3])
    first = first_echoes(rng, poses, body(rng))
    columns = table(Poses(*(np.roll(part, step, axis=0) for part in poses_parts(poses))))
    found = verdict(columns, first)
    assert found.name == name
    assert "off by one" in found.message


@pytest.mark.parametrize("seed", few(range(8), 3))
def test_a_wrong_sampling_rate_is_named(seed):
    """Poses at several distances tell how long ranges are."""
    rng = np.random.default_rng(400 + seed)
    poses = poses_of(rng, "volume")
    factor = (0.5, 0.65, 0.8, 1.25, 1.5, 1.8, 0.6, 0.7)[seed]
    first = factor * first_echoes(rng, poses, body(rng))
    found = verdict(table(poses), first)
    assert found.name == "scale of ranges"
    times = float(re.search(r"that are ([\d.]+) times", found.message)[1])
    assert times * factor == pytest.approx(1.0, abs=0.1)
    assert "import.sampling_rate" in found.message


@pytest.mark.parametrize("seed", few(range(6), 3))
def test_swapped_channels_are_named(seed):
    rng = np.random.default_rng(500 + seed)
    poses = poses_of(rng, KINDS[seed % 3])
    ears = np.array([[0, 0.03, 0], [0, -0.03, 0], [0, 0, 0.03], [0, 0, -0.03]])
    first = first_echoes(rng, poses, body(rng), ears=ears)
    one, other = rng.choice(4, 2, replace=False)
    first[:, [one, other]] = first[:, [other, one]]
    found = verdict(table(poses), first, ears=ears)
    low, high = sorted((one, other))
    assert found.name in (f"channels {low} and {high} swapped", "left-handed frame")
    assert "import.channels" in found.message


@pytest.mark.parametrize("seed", few(range(12), 3))
def test_a_shuffled_table_is_named(seed):
    rng = np.random.default_rng(300 + seed)
    poses = poses_of(rng, KINDS[seed % 3])
    first = first_echoes(rng, poses, body(rng))
    order = rng.permutation(len(poses))
    columns = table(Poses(poses.positions[order], poses.rotations[order]))
    found = verdict(columns, first)
    assert found.name == "shuffled table"
    assert re.match(r"\d+ of \d+ first echoes contradict the others", found.message)


def test_a_turntable_of_the_table_is_reversed_by_its_setting():
    rng = np.random.default_rng(5)
    poses = poses_of(rng, "table")
    first = first_echoes(rng, poses, body(rng))
    angle = -np.arctan2(poses.positions[:, 1], poses.positions[:, 0])
    columns = Columns(
        "t", {"angle": angle, "height": poses.positions[:, 2]}, {}, None, {"angle": "deg"}
    )
    radius = float(np.linalg.norm(poses.positions[0, :2]))
    right = ImportSettings(turntable={"radius": radius})
    wrong = ImportSettings(turntable={"radius": radius, "turns": "clockwise"})
    assert verdict(columns, first, settings=right).name == ""
    found = verdict(columns, first, settings=wrong)
    assert found.name == "reversed turntable"
    assert "import.turntable.turns" in found.message


def test_one_microphone_at_its_emitter_hears_no_mirror():
    rng = np.random.default_rng(6)
    poses = poses_of(rng, "sphere")
    alone = EMITTER[None]
    first = first_echoes(rng, poses, body(rng), ears=alone)
    assert verdict(table(mirrored(poses)), first, ears=alone).name == ""


def test_too_few_or_silent_pings_tell_nothing():
    rng = np.random.default_rng(7)
    poses = poses_of(rng, "sphere")
    first = first_echoes(rng, poses, body(rng))
    few = Poses(poses.positions[:8], poses.rotations[:8])
    assert verdict(table(mirrored(few)), first[:8]).name == ""
    assert verdict(table(mirrored(poses)), np.full_like(first, -np.inf)).name == ""


def test_conventions_that_change_nothing_are_left_out():
    rng = np.random.default_rng(8)
    names = set(alternatives(table(poses_of(rng, "sphere")), PLAIN))
    assert {"left-handed frame", "radians for degrees", "sign of pitch"} <= names
    level = poses_of(rng, "table")
    flat = Poses(level.positions * [1, 1, 0], level.rotations)
    assert not {"sign of z", "sign of pitch"} & set(alternatives(table(flat), PLAIN))


def predicted(poses, first):
    out = poses.positions + poses.rotations @ EMITTER
    back = poses.positions[:, None] + np.einsum("pij,ej->pei", poses.rotations, EARS)
    first = np.where(np.isfinite(first), first, np.nan)
    return predict_ranges((out[:, None] + back) / 2, back - out[:, None], first)


def test_a_sphere_is_found_with_centre_and_size():
    rng = np.random.default_rng(0)
    unit = rng.normal(size=(20_000, 3))
    ball = [0.02, -0.01, 0.03] + 0.04 * unit / np.linalg.norm(unit, axis=1, keepdims=True)
    poses = poses_of(rng, "volume")
    found = predicted(poses, first_echoes(rng, poses, ball))
    np.testing.assert_allclose(found.centre, [0.02, -0.01, 0.03], atol=1e-3)
    assert abs(found.size - 0.04) < 1e-3
    assert np.nanmedian(np.abs(found.residual)) < 1e-3


def test_bodies_of_parts_are_predicted_to_millimetres():
    for seed in range(4):
        rng = np.random.default_rng(seed)
        poses = poses_of(rng, ("sphere", "table")[seed % 2])
        first = first_echoes(rng, poses, body(rng))
        found = predicted(poses, first)
        assert np.nanmedian(np.abs(found.residual)) < 4e-3
        assert np.isnan(found.residual[~np.isfinite(first)]).all()
        assert np.isfinite(found.residual[np.isfinite(first)]).all()


def test_late_echoes_leave_no_body():
    rng = np.random.default_rng(1)
    poses = poses_of(rng, "sphere")
    found = predicted(poses, first_echoes(rng, poses, body(rng)) + 0.15)
    assert found.size < -0.05


def test_few_pings_leave_a_sphere():
    rng = np.random.default_rng(2)
    poses = poses_of(rng, "sphere")[np.arange(0, 90, 6)]
    found = predicted(poses, first_echoes(rng, poses, body(rng)))
    assert np.nanmedian(np.abs(found.residual)) < 0.02


LOOKS = 6.0


def recording(*channels):
    """One second of pings whose channels have so much amplitude."""
    waves = np.random.default_rng(0).normal(size=(20, len(channels), 50))
    waves *= np.reshape(channels, (-1, 1))
    return Recording(
        Path("pings"),
        100.0,
        tuple(map(str, range(20))),
        np.zeros(20),
        lambda ping: waves[ping],
        Columns("t", {}, {}, None, {}),
    )


def test_a_silent_channel_is_refused():
    check_channels(recording(1.0, 1e-6), None)
    with pytest.raises(InputError, match=r"channel 1 is silent in all pings"):
        check_channels(recording(1.0, 0.0), None)
    check_channels(recording(1.0, 0.0), (0,))
    check_channels(recording(0.0, 0.0), None)  # silence of all is told elsewhere


def test_a_doubled_channel_is_refused():
    with pytest.raises(InputError, match=r"channels 0 and 2 hold the same samples"):
        check_channels(recording(1.0, 1.0, 1.0), (0, 1, 0))


def power(*levels, noise=1e-4):
    """Noise, and one echo of some power per channel."""
    rng = np.random.default_rng(1)
    found = noise * rng.gamma(LOOKS, 1.0 / LOOKS, size=(30, len(levels), 300))
    found[:, :, 100] += levels
    return found


def test_levels_noise_and_echoes_are_counted():
    loud, faint = channels_of(power(1.0, 0.1), LOOKS)
    assert loud.level_db == pytest.approx(0.0, abs=0.01)
    assert faint.level_db == pytest.approx(-10.0, abs=0.05)
    assert loud.noise_db == pytest.approx(-42.0, abs=1.5)
    assert (loud.heard, faint.heard, loud.checked) == (30, 30, 30)
    assert faults_of_channels([loud, faint]) == []


def test_channels_that_the_others_contradict_are_named():
    deaf = faults_of_channels(channels_of(power(1.0, 0.0), LOOKS))
    assert len(deaf) == 1
    assert "channel 1 heard echoes in 0 of 30 pings, and another one in 30" in deaf[0]
    faint = faults_of_channels(channels_of(power(1.0, 1e-5, noise=1e-9), LOOKS))
    assert len(faint) == 1
    assert "channel 1 is 50 dB fainter" in faint[0]
