# SPDX-License-Identifier: MIT
from __future__ import annotations

import io
import json
from argparse import Namespace

import numpy as np
import pytest
from PIL import Image

from sononerf import storage
from sononerf.errors import NumericalError
from tools.benchmarks import prey as module
from tools.benchmarks.prey import CONDITIONS, OCCUPIED, plot_png, summary, table


def row(condition, placement=None, **values):
    return {"condition": condition, "placement": placement, **values}


def occupied(condition, placement, score, millimetres):
    return row(
        condition,
        placement,
        score=score,
        told_occupied=score >= OCCUPIED,
        distance_m=millimetres / 1e3,
        found=millimetres <= 10,
        fit_s=30.0,
    )


ROWS = [
    row("a", fit_s=40.0, fscore_5mm=0.9),
    {**occupied("a", 0, 0.6, 4.0), "fscore_5mm": 0.7},
    occupied("a", 1, 0.2, 30.0),
    occupied("a", 2, 0.5, 9.0),
    row("a", 3, failed="no echo"),
    row(
        "a",
        other="calls",
        score=0.1,
        told_occupied=False,
        distance_m=None,
        found=None,
        fscore_5mm=0.8,
    ),
    row("a", other="fit", score=0.3, told_occupied=True, distance_m=None, found=None),
    occupied("b", 0, 0.9, 1.0),
]


def test_a_summary_counts_what_was_told_and_found_and_what_was_told_in_vain():
    assert summary(ROWS, "a") == {
        "condition": "a",
        "placements": 4,
        "told": 2,
        "found": 2,
        "distance_m": 0.009,
        "least_score": 0.2,
        "empty_pairs": 2,
        "false_alarms": 1,
        "most_empty_score": 0.3,
        "empty_fscore_5mm": pytest.approx(0.85),
        "occupied_fscore_5mm": 0.7,
        "fit_s": 40.0,
        "failed": 1,
    }
    assert summary(ROWS, "b")["most_empty_score"] is None


def test_the_table_has_a_line_for_each_condition():
    head, first, second = table(ROWS).splitlines()
    assert head.split()[:3] == ["condition", "told", "found"]
    assert first.split() == "a 2 of 4 2 of 4 9.0 0.20 1 of 2 0.30 0.85 0.70 40 1".split()
    assert second.split() == "b 1 of 1 1 of 1 1.0 0.90 0 of 0 - - - 30 0".split()


def test_the_plot_shows_on_which_side_of_the_bound_the_dots_are():
    def beyond(rows):
        """How far the farthest dot is right of the line, as a part of the picture."""
        with Image.open(io.BytesIO(plot_png(rows))) as image:
            picture = np.array(image.convert("RGB")).astype(int)[:, : image.width // 2]
        red, green, blue = picture.transpose(2, 0, 1)
        dots, line = blue > red + 40, (red > green + 60) & (blue > green + 30)
        line &= ~dots
        farthest = np.nonzero(dots)[1].max() if dots.any() else -np.inf
        return farthest - np.nonzero(line)[1].mean()

    near, far = occupied("a", 0, 0.5, 5.0), occupied("a", 1, 0.5, 40.0)
    assert beyond([near, far]) > 20
    assert beyond([near]) < -20
    assert beyond([row("a", 0, failed="no echo")]) == -np.inf


@pytest.fixture
def asked(monkeypatch):
    """Note which runs are asked for, and leave a comparison that depends on the run."""
    runs, compared = {}, []

    def run_experiment(folder, data, settings, *, enough):
        assert enough == "cost"  # a run without a surface is compared all the same
        if "placement_seed=1" in " ".join(settings):
            raise RuntimeError("exit code 5: no echo")
        runs[folder] = list(settings)
        storage.make_folder(folder)
        geometry = {"fscore": {"0.005": 0.7}}
        if folder.parent.name == "clutter":
            geometry["target"] = {"fscore": {"0.005": 0.4}}
        return {"cost": {"fit_s": 70.0}, "geometry": geometry}

    def compare_runs(first, second, *, output):
        compared.append((first.name, second.name))
        found = (0.1, None) if "empty" in first.name else (0.5, 0.004)
        storage.make_folder(output)
        given = dict(zip(("score", "distance_m"), found, strict=True))
        storage.commit_json(output / "comparison.json", given)

    monkeypatch.setattr(module, "run_experiment", run_experiment)
    monkeypatch.setattr(module, "compare_runs", compare_runs)
    return runs, compared


def arguments(output, **changed):
    plain = {"conditions": ["clutter", "snr-20-db"], "placements": 2, "others": 1, "set": ["a=b"]}
    return Namespace(**{**plain, "output": output, "data": None, "seconds": 60.0, **changed})


def test_each_case_is_a_run_compared_with_the_empty_leaf(asked, tmp_path):
    runs, compared = asked
    text = module.prey(arguments(tmp_path))
    written = json.loads((tmp_path / "prey.json").read_text())
    assert text.startswith("condition") or text.lstrip().startswith("condition")
    assert (tmp_path / "prey.png").stat().st_size > 1000
    assert [
        (r["condition"], r["placement"], r.get("other"), "failed" in r) for r in written["rows"]
    ] == [
        ("clutter", None, None, False),
        ("clutter", 0, None, False),
        ("clutter", 1, None, True),
        ("clutter", None, "calls", False),
        ("clutter", None, "fit", False),
        ("snr-20-db", None, None, False),
        ("snr-20-db", 0, None, False),
        ("snr-20-db", None, "calls", False),
        ("snr-20-db", None, "fit", False),
    ]
    assert compared == [
        (name, "empty") for name in ("prey-0", "empty-other-calls", "empty-other-fit") * 2
    ]
    assert runs[tmp_path / "clutter" / "prey-0"] == [
        "scene.name=clutter",
        "scene.options.target=leaf_dragonfly",
        "scene.options.target_options.placement_seed=0",
        "poses.count=100",
        "poses.heldout=0",
        "a=b",
    ]
    quiet = runs[tmp_path / "snr-20-db" / "empty-other-calls"]
    assert quiet[:2] == ["scene.name=leaf", "fit.seed=1"]
    assert "noise.snr_db=20" in quiet
    first = written["rows"][1]
    assert (first["told_occupied"], first["found"], first["over"]) == (True, True, True)
    alike = written["rows"][3]
    assert (alike["told_occupied"], alike["found"]) == (False, None)
    assert written["summary"][0]["found"] == 1
    assert [of["occupied_fscore_5mm"] for of in written["summary"]] == [0.4, 0.7]


def test_what_was_compared_is_not_compared_again(asked, tmp_path):
    _, compared = asked
    module.prey(arguments(tmp_path, conditions=["clutter"], placements=1))
    before = len(compared)
    module.prey(arguments(tmp_path, conditions=["clutter"], placements=1))
    assert len(compared) == before == 3


def test_what_broke_off_or_cannot_be_compared_fails_alone(asked, monkeypatch, tmp_path):
    """The fit of the first placement has costs of its echoes alone; the other is not comparable."""
    plain = module.run_experiment

    def broken(folder, data, settings, *, enough):
        found = plain(folder, data, settings, enough=enough)
        return {"cost": {"simulate_s": 1.0}} if folder.name == "prey-0" else found

    def silent(first, second, *, output):
        raise NumericalError("nothing to compare: both are silent")

    monkeypatch.setattr(module, "run_experiment", broken)
    monkeypatch.setattr(module, "compare_runs", silent)
    module.prey(arguments(tmp_path, conditions=["clutter"], placements=1))
    rows = json.loads((tmp_path / "prey.json").read_text())["rows"]
    assert [row.get("failed") for row in rows] == [
        None,
        "the fit came to no end",
        "nothing to compare: both are silent",
        "nothing to compare: both are silent",
    ]


def test_the_conditions_change_one_thing_at_a_time_and_their_settings_are_known():
    from sononerf.settings.loading import load_settings
    from tools.benchmarks.experiment import CONFIG

    assert [condition.name for condition in CONDITIONS if condition.main] == [
        "100-calls",
        "clutter",
    ]
    for condition in CONDITIONS:
        settings = load_settings(CONFIG, condition.settings)
        changed = sum(
            (
                settings.poses.count != 100,
                settings.ears.width_deg == 180,
                settings.noise.snr_db is not None,
                condition.cluttered,
            )
        )
        assert changed == (condition.name != "100-calls"), condition.name
