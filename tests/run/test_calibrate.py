# SPDX-License-Identifier: MIT
"""A run's surface corrects a store; what the echoes do not determine is said."""

from __future__ import annotations

import shutil
from types import SimpleNamespace

import numpy as np
import pytest
import trimesh

from sononerf.echoes.store import EnsembleStore
from sononerf.errors import IncompatibleError, InputError, SettingsError
from sononerf.head.front_end import range_axis
from sononerf.refinement.self_calibration import Calibration, Estimate
from sononerf.run import calibrate as module
from sononerf.run.build import with_store
from sononerf.run.calibrate import calibrate, dependent_cells, describe_estimate, kinds_of, moved
from sononerf.run.run import Run
from sononerf.settings.schema import SpectrogramSettings

SPHERE = trimesh.creation.icosphere(subdivisions=3, radius=0.02)


@pytest.fixture
def run(fitted_run, tmp_path, monkeypatch):
    """A run whose surface is the true one."""
    monkeypatch.setattr(module, "MAX_STEPS", 3)
    path = tmp_path / "run"
    shutil.copytree(fitted_run, path)
    (path / "reconstruction").mkdir(exist_ok=True)
    SPHERE.export(path / "reconstruction" / "mesh.ply")
    return path


def test_a_gain_is_taken_off_a_copy(run, tmp_path, tiny_settings):
    store = Run(run).echoes.store
    loud = tmp_path / "loud"
    shutil.copytree(store.path, loud)
    found = calibrate(run, tmp_path / "corrected", ["gain"])
    made = found.store
    assert (len(made), made.missing(), made.damaged()) == (len(store), [], [])
    assert np.abs(found.estimate.calibration.gain).max() < 0.2  # the simulator's level
    factor = np.exp(-found.estimate.calibration.gain)[:, None]
    np.testing.assert_allclose(made.read_pose(0), factor * store.read_pose(0), rtol=1e-5)
    np.testing.assert_array_equal(made.positions, store.positions)
    np.testing.assert_array_equal(made.split, store.split)
    known = made.attributes
    assert known["origin"] == "simulated"
    assert known["calibration"]["self_calibration"]["of"] == str(store.path)
    assert any(line.startswith("gain:") for line in found.lines)
    data = {"data": {"store": str(made.path)}}
    settings = with_store(type(tiny_settings()).model_validate(data))
    assert settings.spectrogram == tiny_settings().spectrogram


def test_the_speed_of_sound_changes_the_ranges(run, tmp_path):
    found = calibrate(run, tmp_path / "corrected", ["speed_of_sound"])
    store = Run(run).echoes.store
    ratio = found.store.attributes["speed_of_sound"] / store.attributes["speed_of_sound"]
    np.testing.assert_allclose(found.store.range, np.asarray(store.range) * ratio, rtol=1e-6)
    spectrogram = SpectrogramSettings(**found.store.attributes["settings"]["spectrogram"])
    speed = found.store.attributes["speed_of_sound"]
    np.testing.assert_allclose(range_axis(spectrogram, speed), found.store.range, rtol=1e-6)
    assert any("one distance" in line for line in found.warnings)
    assert EnsembleStore.open(tmp_path / "corrected").attributes["settings"]["air"][
        "speed_of_sound"
    ] == pytest.approx(found.store.attributes["speed_of_sound"])


def test_what_is_not_determined_is_said(run):
    fitted = Run(run)
    store = fitted.echoes.store
    kinds = ("gain", "range_offset", "speed_of_sound")
    estimate = Estimate(
        Calibration(np.zeros((2, 3))),
        {"gain": 0.5, "range_offset": 0.01, "speed_of_sound": 0.1},
        [3.0, 2.9],
    )
    _, warnings = describe_estimate(fitted.head, store, SPHERE, estimate, kinds)
    text = "\n".join(warnings)
    for words in (
        "gain: the echoes do not determine it",
        "range_offset: the echoes do not separate it",
        "gain and range_offset together",
        "speed_of_sound: all poses are at one distance",
    ):
        assert words in text


def test_a_turntable_hardly_tells_a_range_offset(run):
    fitted = Run(run)
    store = fitted.echoes.store
    angle = np.arange(len(store))
    turned = SimpleNamespace(
        indices=store.indices,
        positions=np.stack([np.cos(angle), np.sin(angle), 0.1 * angle], axis=1),
    )
    estimate = Estimate(Calibration(np.zeros((2, 3))), {"range_offset": 1e-4}, [])
    for poses, warned in ((store, False), (turned, True)):
        _, warnings = describe_estimate(fitted.head, poses, SPHERE, estimate, ("range_offset",))
        assert any("those of a turntable" in line for line in warnings) == warned


def test_bad_input_is_one_line_and_leaves_nothing(run, tmp_path):
    with pytest.raises(SettingsError, match="unknown error 'gian'; known: gain"):
        calibrate(run, tmp_path / "out", ["gian"])
    with pytest.raises(SettingsError, match="no error is given"):
        kinds_of([])
    with pytest.raises(SettingsError, match="unknown error 'lag'; known: gain"):
        calibrate(run, tmp_path / "out", ["lag"])
    assert not (tmp_path / "out").exists()
    (run / "reconstruction" / "mesh.ply").unlink()
    with pytest.raises(InputError, match=r"mesh\.ply: there is no surface"):
        calibrate(run, tmp_path / "out", ["gain"])
    assert not (tmp_path / "out").exists()
    SPHERE.export(run / "reconstruction" / "mesh.ply")
    with pytest.raises(IncompatibleError, match="holds something already"):
        calibrate(run, run, ["gain"])


def test_echoes_are_moved_between_slices():
    axis = 0.3 + 0.001 * np.arange(10)
    heard = np.arange(10.0)[None, :, None] * np.ones((2, 1, 3))
    np.testing.assert_allclose(moved(heard, axis, 0.0025)[0, :7, 0], np.arange(7) + 2.5)
    np.testing.assert_array_equal(moved(heard, axis, 0.0), heard)


def test_cells_share_noise_by_window_and_hop():
    assert dependent_cells(SpectrogramSettings(hop=2)) == pytest.approx(
        2 * dependent_cells(SpectrogramSettings(hop=4))
    )
    assert dependent_cells(SpectrogramSettings(hop=64, fft=64)) < 3
