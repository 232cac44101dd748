# SPDX-License-Identifier: MIT
"""Recordings become a store, the same bytes each time; bad ones leave nothing behind."""

from __future__ import annotations

import numpy as np
import pytest

from sononerf.echoes.echoes import Echoes
from sononerf.echoes.store import EnsembleStore
from sononerf.errors import (
    IncompatibleError,
    InputError,
    LockedError,
    NumericalError,
    SettingsError,
)
from sononerf.run.import_recordings import (
    check_before,
    describe_plan,
    draw_plan,
    plan_import,
    write_import,
)
from sononerf.storage import lock
from tests.recordings.recorded import SETTINGS, TARGET, arrays, waveforms

GIVEN = (*SETTINGS, "import.source=by formula", "import.licence=CC0")


@pytest.fixture
def brought(tmp_path):
    """Import arrays with some changes and settings into a store."""

    def run(*overrides, output="store", **changes):
        np.savez(tmp_path / "a.npz", **arrays(**changes))
        source, target = tmp_path / "a.npz", tmp_path / output
        known = plan_import("numpy", source, target, overrides=[*GIVEN, *overrides])
        return write_import(known, target)

    return run


def test_the_noise_of_a_sweep_is_not_its_precursors(brought):
    loudest = abs(waveforms()).max()
    noise = [
        brought(waveform=waveforms(noise=part * loudest), output=f"{part}")[0].attributes["noise"]
        for part in (0.01, 0.03)
    ]
    assert np.mean(noise[1]) / np.mean(noise[0]) == pytest.approx(3.0, rel=0.08)


def files(folder):
    return {p.relative_to(folder): p.read_bytes() for p in folder.rglob("*") if p.is_file()}


def test_a_store_knows_all_that_a_fit_needs(brought):
    store, verdict = brought()
    known = store.attributes
    assert verdict.message == ""
    assert (len(store), store.receivers, store.missing(), store.damaged()) == (24, 2, [], [])
    assert (known["origin"], known["source"], known["licence"]) == ("recorded", "by formula", "CC0")
    assert set(known["settings"]) == {"air", "ears", "call", "spectrogram", "support"}
    assert Echoes.open(store.path).head.plane is None
    assert known["settings"]["spectrogram"]["sampling_rate"] == 250e3
    assert known["settings"]["call"]["kind"] == "linear"
    assert (known["origin"], len(known["echo_hash"])) == ("recorded", 64)
    assert known["speed_of_sound"] == 343.0
    assert known["noise_floor_of"] is None  # the sweep's own precursors hide the rounding
    loudest = max(store.read_pose(int(i)).max() for i in store.indices("train"))
    assert known["reference"] == pytest.approx(1e-3 * loudest)


def test_a_turntable_is_a_support(brought, tmp_path):
    """Its height is stated in the import or in a section of its own; the store knows it."""
    angle = np.arange(24) * 15.0
    table = {"position_mm": None, "euler_deg": None, "angle_deg": angle, "height_mm": 0 * angle}
    stated = "import.turntable={radius: 0.3, surface: -0.05}"
    store, _ = brought(stated, output="one", **table)
    plane = Echoes.open(store.path).head.plane
    assert (plane.point, plane.normal) == ((0.0, 0.0, -0.05), (0.0, 0.0, 1.0))
    own, _ = brought(
        "import.turntable={radius: 0.3}", "support.point=[0, 0, -0.05]", output="two", **table
    )
    assert Echoes.open(own.path).head.plane == plane
    with pytest.raises(SettingsError, match=r"support: normal gives no direction"):
        brought("support.normal=[0, 0, 0]", output="three")


def test_echoes_are_where_the_target_is(brought):
    store, _ = brought()
    for index in range(4):
        power = np.square(store.read_pose(index)).mean(axis=(0, 2))
        distance = np.linalg.norm(store.positions[index] - TARGET)
        assert store.range[power.argmax()] == pytest.approx(distance, abs=3e-3)


def test_the_same_again_is_the_same_bytes_and_costs_nothing(brought, tmp_path, monkeypatch):
    store, _ = brought()
    before = files(store.path)
    assert files(brought(output="again")[0].path) == before
    monkeypatch.setattr(EnsembleStore, "create", None)
    assert brought()[0].path == store.path
    assert files(store.path) == before


def test_what_changes_the_echoes_is_another_ensemble(brought):
    brought()
    for changes in (
        {"waveform": 1.001 * waveforms()},
        {"start": 1e-6},
        {"position_m": arrays()["position_m"] + 1e-4},
    ):
        with pytest.raises(IncompatibleError, match="holds other echoes"):
            brought(**changes)
    with pytest.raises(IncompatibleError):
        brought("import.scale=2")
    brought("import.source=somebody else")  # says nothing of the echoes


def test_an_interrupted_import_goes_on(brought, tmp_path):
    store, _ = brought()
    whole = files(store.path)
    chunk = next((store.path / "spectrogram").glob("c.5.*"))
    chunk.unlink()
    assert brought()[0].missing() == []
    assert files(store.path) == whole


def test_the_same_import_mends_a_damaged_pose(brought):
    store, _ = brought()
    whole = files(store.path)
    chunk = next((store.path / "spectrogram").glob("c.5.*"))
    data = bytearray(chunk.read_bytes())
    data[len(data) // 2] ^= 1
    chunk.write_bytes(data)
    assert brought()[0].damaged() == []
    assert files(store.path) == whole


def test_repeated_pings_tell_the_noise_floor(brought):
    given = arrays()
    twice = {name: np.repeat(given[name], 2, axis=0) for name in ("position_m", "rotation")}
    waves = np.repeat(given["waveform"], 2, axis=0)
    waves += 1e-5 * np.random.default_rng(1).standard_normal(waves.shape)
    store, _ = brought(waveform=waves, **twice)
    assert 0.01 < store.attributes["noise_floor_mae_db"] < 3
    split = store.split
    np.testing.assert_array_equal(split[::2], split[1::2])


def mirrored():
    given, mirror = arrays(), np.diag([1.0, -1.0, 1.0])
    return {
        "waveform": waveforms(call={"kind": "impulse"}),
        "position_m": given["position_m"] @ mirror,
        "rotation": mirror @ given["rotation"] @ mirror,
    }


def test_a_wrong_convention_is_named(brought):
    store, verdict = brought("call={kind: impulse}", **mirrored())
    assert verdict.name == "left-handed frame"
    assert len(store) == 24


def test_what_is_bad_leaves_nothing_behind(brought, tmp_path):
    bad = waveforms()
    bad[3, 1, 50] = np.nan
    with pytest.raises(InputError, match="NaN"):
        brought(waveform=bad)
    with pytest.raises(InputError, match="24 pings and 20 poses"):
        brought(position_m=np.zeros((20, 3)), rotation=np.stack([np.eye(3)] * 20))
    assert not (tmp_path / "store").exists()
    with pytest.raises(NumericalError, match="all recordings are silent"):
        brought(waveform=np.zeros((24, 2, 1600)))


def test_poses_are_checked_without_a_store(tmp_path):
    np.savez(tmp_path / "a.npz", **arrays(**mirrored()))
    given = [*GIVEN, "call={kind: impulse}"]
    known = plan_import("numpy", tmp_path / "a.npz", tmp_path / "s", overrides=given)
    assert check_before(known).name == "left-handed frame"
    assert not (tmp_path / "s").exists()


def test_a_store_in_use_is_not_touched(brought, tmp_path):
    with lock(tmp_path / "store"), pytest.raises(LockedError, match="in use"):
        brought()


def test_what_was_understood_is_said_and_drawn(tmp_path):
    np.savez(tmp_path / "a.npz", **arrays())
    known = plan_import("numpy", tmp_path / "a.npz", tmp_path / "s", overrides=GIVEN)
    text = "\n".join(describe_plan(known))
    for words in (
        "a.npz (numpy), 250000 Hz",
        "24 read, 6.4 ms each, 0 clipped and rejected; 21 train, 1 validation, 2 test",
        "channel 1:  loudest echo",
        "echoes in 24 of 24 pings",
        "receivers:  2, omnidirectional",
        "frame enu; lengths in m",
        "linear, 20 to 80 kHz",
        "(window 42, hop 2, fft 128)",
        "343.0 m/s",
        "import.compress=true resolves them to",
    ):
        assert words in text
    known = plan_import(
        "numpy", tmp_path / "a.npz", tmp_path / "s", overrides=[*GIVEN, "import.compress=true"]
    )
    text = "\n".join(describe_plan(known))
    assert "impulse, by pulse compression" in text
    assert "import.compress=true" not in text
    assert draw_plan(known, tmp_path / "p").read_bytes().startswith(b"\x89PNG")
    assert not (tmp_path / "s").exists()
