# SPDX-License-Identifier: MIT
"""Tables of whole experiments, from metrics made by hand; nothing is fitted here."""

from __future__ import annotations

import json
import subprocess

import pytest

from sononerf.errors import IncompatibleError
from sononerf.settings.loading import dump_yaml, load_settings
from tools.benchmarks import experiment
from tools.benchmarks.experiment import CONFIG, row_of, run_experiment, run_series, summary, table

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
ROW = {
    "fit_s": 41.0,
    "fscore_1mm": 0.62,
    "fscore_2mm": 0.99,
    "fscore_5mm": 1.0,
    "chamfer_m": 0.00091,
    "thickness_bias_m": 0.00088,
    "volume_ratio": 1.19,
    "parts": 3,
    "parts_true": 3,
    "heldout_mae_db_active": 3.28,
    "backprojection_fscore_5mm": 0.73,
}


def test_a_row_is_taken_from_the_metrics():
    assert row_of(METRICS) == ROW


@pytest.mark.parametrize(
    "metrics",
    [{}, {"prediction": None, "geometry": None, "baseline": {"backprojection": None}}],
)
def test_what_a_run_does_not_have_is_none(metrics):
    assert row_of(metrics) == dict.fromkeys(ROW)


def shape(seed, kind, extent, **other):
    return {"seed": seed, "kind": kind, "extent_m": extent, "over": False, **other}


def rows():
    bad = {"fit_s": 71.0, "fscore_1mm": 0.2, "chamfer_m": 0.005, "thickness_bias_m": -0.003}
    bad |= {"volume_ratio": 0.5, "parts": 2, "backprojection_fscore_5mm": None, "over": True}
    partial = {"fit_s": 50.0, "fscore_1mm": 0.4, "volume_ratio": None}
    return [
        shape(0, "cluster", 0.084, **ROW),
        shape(1, "box", 0.1, **{**ROW, **bad}),
        shape(2, "torus", 0.12, **{**ROW, **partial}),
        shape(3, "capsules", 0.07, failed="no surface"),
    ]


def test_the_summary_is_median_and_worst_of_what_ended():
    found = summary(rows())
    assert found["median"]["fit_s"] == 50.0
    assert found["median"]["fscore_1mm"] == 0.4
    assert found["median"]["volume_ratio"] == pytest.approx((1.19 + 0.5) / 2)
    # Worst is what lies furthest on the bad side: a bias or a volume may be off either way.
    assert found["worst"]["fit_s"] == 71.0
    assert found["worst"]["fscore_1mm"] == 0.2
    assert found["worst"]["chamfer_m"] == 0.005
    assert found["worst"]["thickness_bias_m"] == -0.003
    assert found["worst"]["volume_ratio"] == 0.5
    assert found["worst"]["backprojection_fscore_5mm"] == 0.73
    assert "parts" not in found["median"]
    assert (found["runs"], found["failed"], found["over"], found["parts_as_true"]) == (4, 1, 1, 2)


def test_the_summary_of_nothing_is_empty():
    counts = dict.fromkeys(("runs", "failed", "over", "parts_as_true"), 0)
    assert summary([]) == {"median": {}, "worst": {}, **counts}


def test_the_table_shows_every_run_in_its_units():
    lines = table(rows()).splitlines()
    assert lines[0].split()[:4] == ["seed", "kind", "extent/cm", "fit/s"]
    assert "calls" not in lines[0]
    expected = "0 cluster 8.4 41 0.62 0.99 1.00 0.91 +0.88 1.19 3 3 3.28 0.73"
    assert lines[1].split() == expected.split()
    assert lines[2].endswith("-  over")
    assert lines[2].split()[8:11] == ["-3.00", "0.50", "2"]
    assert lines[4].split()[:3] == ["3", "capsules", "7.0"]
    assert lines[4].endswith("failed: no surface")
    assert lines[5].split()[:3] == ["median", "50", "0.40"]
    assert lines[6].split()[:3] == ["worst", "71", "0.20"]
    assert lines[7] == ("2 of 4 with as many parts as in truth; 1 over the time, 1 failed")
    # Numbers stand under their titles, at the right.
    assert lines[1].index("8.4") + 3 == lines[0].index("extent/cm") + 9


def series(monkeypatch, tmp_path, outcomes, after=lambda rows: None):
    """Run a series whose runs end as told."""
    asked = []

    def run(folder, data, settings):
        asked.append((folder, data, list(settings)))
        outcome = outcomes[len(asked) - 1]
        if isinstance(outcome, BaseException):
            raise outcome
        return outcome

    monkeypatch.setattr(experiment, "run_experiment", run)
    experiments = [(str(n), {"calls": n}, [f"poses.count={n}"]) for n in range(len(outcomes))]
    text = run_series(tmp_path, "t.json", experiments, data=None, seconds=40.0, after=after)
    return text, asked


def test_a_series_runs_each_and_keeps_the_table(monkeypatch, tmp_path):
    seen = []
    outcomes = [METRICS, RuntimeError("exit code 5: error: no echo"), METRICS]
    text, asked = series(monkeypatch, tmp_path, outcomes, lambda rows: seen.append(len(rows)))
    assert asked[1] == (tmp_path / "1", tmp_path / "data", ["poses.count=1"])
    assert text.endswith(f"wrote {tmp_path / 't.json'}")
    assert seen == [1, 2, 3]
    kept = json.loads((tmp_path / "t.json").read_text())
    assert [row["calls"] for row in kept["rows"]] == [0, 1, 2]
    assert kept["rows"][0] == {**ROW, "calls": 0, "over": True, "settings": ["poses.count=0"]}
    assert kept["rows"][1]["failed"] == "exit code 5: error: no echo"
    assert (kept["seconds"], kept["over"], kept["failed"]) == (40.0, 2, 1)
    assert kept["median"]["fit_s"] == 41.0


@pytest.mark.parametrize(
    ("end", "said"), [(KeyboardInterrupt(), "goes on"), (IncompatibleError("other"), "other")]
)
def test_an_end_of_all_leaves_the_table_so_far(monkeypatch, tmp_path, end, said):
    with pytest.raises(SystemExit, match=said):
        series(monkeypatch, tmp_path, [METRICS, end, METRICS])
    assert len(json.loads((tmp_path / "t.json").read_text())["rows"]) == 1


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
