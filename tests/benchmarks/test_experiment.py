# SPDX-License-Identifier: MIT
"""Tables of whole experiments, from metrics made by hand; nothing is fitted here."""

from __future__ import annotations

import json
import subprocess

import pytest

from sononerf.errors import IncompatibleError
from sononerf.settings.loading import dump_yaml, load_settings
from tools.benchmarks import experiment
from tools.benchmarks.experiment import CONFIG, run_experiment

pytestmark = pytest.mark.thorough

METRICS = {
    "schema": 1,
    "cost": {"simulate_s": 60.0, "fit_s": 41.0, "reconstruct_s": 9.0},
    "prediction": {"mae_db": 0.8, "mae_db_active": 3.28},
    "geometry": {
        "chamfer_m": 0.00091,
        "fscore": {"0.001": 0.62, "0.002": 0.99, "0.005": 1.0},
        "thickness_bias_m": 0.00088,
        "volume_ratio": 1.19,
        "components": 3,
        "components_true": 3,
    },
    "baseline": {"backprojection": {"fscore": {"0.005": 0.73}}},
}
SETTINGS = ["scene.name=sphere", "poses.count=5", "poses.heldout=0", "poses.validation=0"]


def child(monkeypatch, code, said="", metrics=None):
    """Replace the command by one that says something, leaves metrics, and ends with a code."""
    commands = []

    def run(command, *, stdout, stderr, check):
        commands.append(command)
        stdout.write(said)
        if metrics is not None:
            folder = experiment.Path(command[-1])
            folder.mkdir(parents=True)
            (folder / "metrics.json").write_text(json.dumps(metrics))
        return subprocess.CompletedProcess(command, code)

    monkeypatch.setattr(experiment.subprocess, "run", run)
    return commands


def test_an_experiment_is_the_command_with_its_settings(monkeypatch, tmp_path):
    commands = child(monkeypatch, 0, metrics=METRICS)
    assert run_experiment(tmp_path / "run", tmp_path / "data", SETTINGS) == METRICS
    ((_, *command),) = commands
    assert command[:8] == ["-m", "sononerf.cli", "fit", str(CONFIG), *SETTINGS]
    assert command[8].startswith(f"data.store={tmp_path / 'data' / 'sphere'}-")
    assert command[9:] == ["--output", str(tmp_path / "run")]


def test_a_finished_run_is_left_as_it_is(monkeypatch, tmp_path):
    commands = child(monkeypatch, 0)
    run = tmp_path / "run"
    run.mkdir()
    (run / "config.yaml").write_text(dump_yaml(load_settings(CONFIG, SETTINGS)))
    (run / "metrics.json").write_text(json.dumps(METRICS))
    assert run_experiment(run, tmp_path / "data", SETTINGS) == METRICS
    assert commands == []
    with pytest.raises(IncompatibleError, match=r"poses\.count"):
        run_experiment(run, tmp_path / "data", [*SETTINGS, "poses.count=6"])
    # Without what is written last it is not finished.
    (run / "metrics.json").write_text(json.dumps({"schema": 1, "cost": METRICS["cost"]}))
    run_experiment(run, tmp_path / "data", SETTINGS)
    assert len(commands) == 1


def test_a_failed_command_is_told_of_with_its_last_line(monkeypatch, tmp_path):
    child(monkeypatch, 5, said="simulating\nerror: no echo\n\n")
    with pytest.raises(RuntimeError, match=r"^exit code 5: error: no echo$"):
        run_experiment(tmp_path / "run", tmp_path / "data", SETTINGS)
    assert "simulating" in (tmp_path / "run.log").read_text()


@pytest.mark.parametrize("code", [130, 143, -2])
def test_a_stopped_command_stops_the_rest(monkeypatch, tmp_path, code):
    child(monkeypatch, code)
    with pytest.raises(KeyboardInterrupt):
        run_experiment(tmp_path / "run", tmp_path / "data", SETTINGS)


def test_a_killed_command_is_a_failed_one(monkeypatch, tmp_path):
    child(monkeypatch, -9)
    with pytest.raises(RuntimeError, match="exit code -9: nothing was said"):
        run_experiment(tmp_path / "run", tmp_path / "data", SETTINGS)


def test_a_command_that_wrote_enough_has_not_failed(monkeypatch, tmp_path):
    child(monkeypatch, 5, said="error: no surface", metrics={"prediction": {"mae_db": 0.8}})
    chosen = (tmp_path / "run", tmp_path / "data", SETTINGS)
    assert run_experiment(*chosen, enough="prediction")["prediction"] == {"mae_db": 0.8}
    child(monkeypatch, 5, said="error: no surface")
    for section in ("baseline", None):
        with pytest.raises(RuntimeError, match="no surface"):
            run_experiment(*chosen, enough=section)
    # One that was stopped goes on another time.
    child(monkeypatch, 130)
    with pytest.raises(KeyboardInterrupt):
        run_experiment(*chosen, enough="prediction")


def test_another_file_is_run_with_its_own_settings(monkeypatch, tmp_path):
    commands = child(monkeypatch, 0)
    config = CONFIG.with_name("smoke.yaml")
    run_experiment(tmp_path / "a", tmp_path / "data", [], config=config)
    run_experiment(tmp_path / "b", tmp_path / "data", [])
    assert [command[4] for command in commands] == [str(config), str(CONFIG)]
    first, second = (command[5] for command in commands)
    assert first.startswith(f"data.store={tmp_path / 'data' / 'three_spheres'}-")
    assert first != second  # other poses, other echoes
