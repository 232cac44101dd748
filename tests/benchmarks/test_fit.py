# SPDX-License-Identifier: MIT
"""Time to a held-out error, from metrics made by hand; nothing is fitted here."""

from __future__ import annotations

import json
from argparse import Namespace

import pytest

from tools.benchmarks import fit as module
from tools.benchmarks.fit import EPOCHS

pytestmark = pytest.mark.thorough

ERRORS = {1: 0.9, 2: 0.6, 3: 0.45}


def series(monkeypatch, output, errors=ERRORS, **other):
    asked = []

    def experiment(folder, data, settings, *, enough):
        asked.append((folder.name, data, list(settings), enough))
        epochs, seed = (int(folder.name.split("-")[i]) for i in (0, 3))
        cost = {"steps": 67 * epochs, "fit_s": 10.0 * epochs + seed**2, "device": "cpu"}
        error = errors.get(epochs, 0.5) + 0.01 * seed
        return {"cost": cost, "prediction": {"mae_db": error}}

    monkeypatch.setattr(module, "run_experiment", experiment)
    chosen = {"scene": "ua", "error": 0.45, "set": ["poses.count=9"], "output": output}
    chosen |= {"data": None, "compare": None, **other}
    return asked, lambda: module.fit(Namespace(**chosen))


def kept(output):
    (file,) = output.glob("fit-*.json")
    return json.loads(file.read_text())


def test_the_first_that_is_good_enough_is_repeated(monkeypatch, tmp_path):
    asked, go = series(monkeypatch, tmp_path)
    text = go()
    names = [f"{n}-epochs-seed-0" for n in (1, 2, 3)]
    names += [f"3-epochs-seed-{seed}" for seed in (1, 2, 3, 4)]
    assert [name for name, *_ in asked] == names
    own = ["scene.name=ua", "fit.epochs=3", "fit.seed=4", "poses.count=9"]
    assert asked[-1] == (names[-1], tmp_path / "data", own, "prediction")
    found = kept(tmp_path)
    # Of 30, 31, 34, 39 and 46 s, and of 0.45 to 0.49 dB.
    assert (found["epochs"], found["fit_s"], found["error_db"]) == (3, 34.0, 0.45)
    assert found["mae_db"] == pytest.approx(0.47)
    assert [row["name"] for row in found["rows"]] == names
    assert "0.45 dB: 34.0 s, 3 epochs, 0.47 dB (medians of 5 seeds)" in text


def test_an_error_that_is_never_reached_is_told_of(monkeypatch, tmp_path):
    asked, go = series(monkeypatch, tmp_path, errors={})
    assert "0.45 dB: not reached" in go()
    assert len(asked) == len(EPOCHS)
    found = kept(tmp_path)
    assert (found["epochs"], found["fit_s"], found["mae_db"]) == (None, None, None)


def test_without_held_out_poses_there_is_no_error(monkeypatch, tmp_path):
    _, go = series(monkeypatch, tmp_path)
    monkeypatch.setattr(module, "run_experiment", lambda *given, **more: {"cost": {}})
    with pytest.raises(SystemExit, match=r"poses\.heldout must be above 0"):
        go()


def test_it_is_compared_with_an_older_file(monkeypatch, tmp_path):
    old = tmp_path / "old.json"
    old.write_text(json.dumps({"fit_s": 17.0}))
    _, go = series(monkeypatch, tmp_path / "new", compare=old)
    line = next(line for line in go().splitlines() if line.split()[:1] == ["fit_s"])
    assert line.split() == ["fit_s", "17", "34", "2.00"]


def test_a_file_that_cannot_be_read_is_told_before_anything_runs(monkeypatch, tmp_path):
    asked, go = series(monkeypatch, tmp_path, compare=tmp_path / "none.json")
    with pytest.raises(SystemExit, match=r"none\.json"):
        go()
    assert asked == []
