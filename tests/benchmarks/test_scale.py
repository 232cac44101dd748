# SPDX-License-Identifier: MIT
"""How cost grows, from metrics made by hand; nothing is fitted here."""

from __future__ import annotations

import json
import subprocess
import sys
from argparse import Namespace

import pytest

from sononerf.run.build import check_plugins, head_of
from sononerf.scene.scene import load_scene
from sononerf.settings.loading import load_settings
from tools.benchmarks import scale as module
from tools.benchmarks.experiment import CONFIG
from tools.benchmarks.scale import OTHERS, powers, sentences, table, watched


def metrics(poses):
    """Simulating grows with the poses, reading out with their root, a step with that one's root."""
    step_s = 0.02 * (poses / 100) ** 0.25
    cost = {"simulate_s": 0.1 * poses, "fit_s": step_s * 3 * poses, "steps": 3 * poses}
    cost["reconstruct_s"] = 0.5 * poses**0.5
    geometry = {"fscore": {"0.002": 0.9}}
    return {"cost": cost, "prediction": {"mae_db": 0.4}, "geometry": geometry}


def series(monkeypatch, output, fail=(), axes=("poses",), counts=(100, 400)):
    asked = []

    def experiment(folder, data, settings):
        asked.append((folder.name, list(settings)))
        if folder.name in fail:
            raise RuntimeError("exit code 3: no surface")
        return metrics(int(folder.name.rpartition("-")[2]))

    monkeypatch.setattr(module, "run_experiment", experiment)
    chosen = {"counts": counts, "axes": list(axes), "set": ["fit.epochs=3"], "data": None}
    return asked, module.scale(Namespace(output=output, **chosen))


def test_costs_grow_by_the_powers_they_were_made_with(monkeypatch, tmp_path):
    asked, text = series(monkeypatch, tmp_path)
    assert asked == [
        ("poses-100", ["poses.count=100", "fit.epochs=3"]),
        ("poses-400", ["poses.count=400", "fit.epochs=3"]),
    ]
    found = json.loads((tmp_path / "scale.json").read_text())["powers"]["poses"]
    assert found["simulate_s"] == pytest.approx(1.0)
    assert found["step_s"] == pytest.approx(0.25)
    assert found["reconstruct_s"] == pytest.approx(0.5)
    line = next(each.split() for each in text.splitlines() if "400" in each.split()[:2])
    assert line[:7] == ["poses", "400", "40.0", "1200", "34", "28.3", "10.0"]
    assert "poses: simulate 1.00, step 0.25, reconstruct 0.50" in text


def test_a_second_look_takes_time_and_memory_of_the_first(monkeypatch, tmp_path):
    series(monkeypatch, tmp_path)
    before = json.loads((tmp_path / "scale.json").read_text())
    asked, _ = series(monkeypatch, tmp_path)
    assert asked == []
    assert json.loads((tmp_path / "scale.json").read_text()) == before


def test_one_that_fails_is_told_of_and_is_in_no_power(monkeypatch, tmp_path):
    asked, text = series(monkeypatch, tmp_path, fail=("poses-1600",), counts=(100, 400, 1600))
    assert len(asked) == 3
    assert "poses 1600: exit code 3: no surface" in text
    found = json.loads((tmp_path / "scale.json").read_text())["powers"]["poses"]
    assert found["simulate_s"] == pytest.approx(1.0)
    # It is tried again by the same command.
    asked, _ = series(monkeypatch, tmp_path, counts=(100, 400, 1600))
    assert [name for name, _ in asked] == ["poses-1600"]


def test_one_row_tells_no_power():
    assert powers([{"axis": "poses", "value": 100, "step_s": 1.0}]) == {}
    assert "poses" not in sentences({})


def test_all_axes_are_looked_at_unless_some_are_chosen(monkeypatch, tmp_path):
    asked, _ = series(monkeypatch, tmp_path / "all", axes=())
    assert [name for name, _ in asked] == ["poses-100", "poses-400", *(c.name for c in OTHERS)]
    asked, _ = series(monkeypatch, tmp_path / "some", axes=("size",))
    assert [name for name, _ in asked] == ["size-1", "size-2", "size-3"]


@pytest.mark.parametrize("case", OTHERS, ids=lambda case: case.name)
def test_each_case_is_what_it_says(case, quick_ears):
    settings = load_settings(CONFIG, case.settings)
    check_plugins(settings, head_of(settings))
    scene = load_scene(settings.scene.name, settings.scene.options)
    plain = load_scene("three_spheres", {})
    if case.axis == "slices":
        assert len(head_of(settings).range) == case.value
    elif case.axis == "size":
        assert scene.mesh.extents == pytest.approx(case.value * plain.mesh.extents)
        reach = abs(scene.mesh.vertices).max() * 3**0.5
        assert settings.poses.radius + reach < settings.spectrogram.range_max + 0.1
    else:
        assert settings.field.options["spacing"] == pytest.approx(1 / case.value)


def test_memory_is_that_of_what_was_started():
    code = "import time; held = b'1' * 200_000_000; time.sleep(1.5)"
    with watched() as seen:
        # Of a process that a process of ours started, as workers of a simulation are.
        subprocess.run(["sh", "-c", '"$0" -c "$1"; true', sys.executable, code], check=True)
    assert 2.0e8 < seen["memory_bytes"] < 3.5e8
    assert 1.5 < seen["wall_s"] < 30


def test_the_table_has_a_dash_for_what_is_not_known():
    line = table([{"axis": "poses", "value": 100, "fit_s": 3.2}]).splitlines()[1].split()
    assert line == ["poses", "100", "-", "-", "3", *["-"] * 6]
