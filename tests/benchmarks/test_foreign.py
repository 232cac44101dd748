# SPDX-License-Identifier: MIT
"""The table of bodies that nobody of this project drew."""

from __future__ import annotations

import argparse
import json

import pytest
import torch
import trimesh

from tools.benchmarks import foreign as module
from tools.benchmarks.foreign import foreign, rows_of, settings_of, table


def score(value):
    return {"chamfer_m": 0.002 - 0.001 * value, "fscore_2mm": value, "fscore_5mm": 1.0} | {
        "parts": 2,
        "parts_true": 1,
    }


def row(name, levels, other, result, calls=400):
    return {
        "name": name,
        "calls": calls,
        "starts": {"open": score(0.5), "levels": score(levels)},
        "refined": {"open": score(other), "levels": score(levels + 0.1)},
        "result": score(result),
        "chosen": "levels",
        "kept": result != levels,
        "fit_s": 20.0,
        "surface_s": 40.0,
    }


def test_the_table_shows_starts_candidates_and_result_and_what_a_right_choice_would_give():
    rows = [row("a", 0.7, 0.9, 0.8), row("b", 0.6, 0.4, 0.6), row("c", 0.2, 0.1, 0.3, calls=25)]
    lines = [line.split() for line in table(rows).splitlines() if line]
    first, second, median, least = lines[1:5]
    # levels, open; refined the same; best, result, F 5mm, mm, parts, true, s, chosen
    assert first[:5] == ["a", "0.70", "0.50", "0.80", "0.90"]
    assert first[5:] == ["0.90", "0.80", "1.00", "1.20", "2", "1", "60", "levels"]
    assert second[-2:] == ["levels,", "unrefined"]
    assert median[:3] == ["median", "0.65", "0.50"]
    assert least[:3] == ["least", "0.60", "0.50"]
    assert [line[0] for line in lines].count("c") == 1
    assert [line[:2] for line in lines if line[1] == "calls"] == [["400", "calls"], ["25", "calls"]]


def given(folder, output):
    return argparse.Namespace(foreign=folder, output=output, calls=[100, 25], set=["fit.seed=1"])


def test_each_body_is_measured_once_for_each_number_of_calls(tmp_path, monkeypatch):
    for name in ("b.ply", "a.stl"):
        trimesh.creation.box((0.1, 0.1, 0.1)).export(tmp_path / name)
    (tmp_path / "notes.txt").write_text("no mesh")
    seen = []

    def measured(body, settings, output):
        seen.append((body.name, settings[-2]))
        return {k: v for k, v in row("", 0.5, 0.4, 0.6).items() if k not in ("name", "calls")}

    monkeypatch.setattr(module, "measured", measured)
    for _ in range(2):  # the second time all is there
        said = foreign(given(tmp_path, tmp_path / "out"))
    assert seen == [(n, f"poses.count={c}") for c in (100, 25) for n in ("a.stl", "b.ply")]
    assert "wrote" in said
    with (tmp_path / "out" / "foreign.jsonl").open("a") as opened:
        opened.write('{"name": "torn')
    assert len(rows_of(tmp_path / "out" / "foreign.jsonl")) == 4


def test_a_folder_without_a_mesh_is_refused(tmp_path):
    with pytest.raises(SystemExit, match=r"holds no mesh \(\.ply"):
        foreign(given(tmp_path, tmp_path / "out"))


def test_a_body_is_a_scene_in_metres(tmp_path):
    settings = settings_of(tmp_path / "x.ply", 25, ["fit.seed=1"])
    assert settings[0] == "scene.name=mesh"
    assert {"scene.options.unit=m", "poses.count=25", "fit.seed=1"} <= set(settings)
    assert json.dumps(settings)


def test_of_each_start_the_surface_with_the_lowest_objective_counts():
    def stage(objective, height):
        corners = torch.tensor([[0.0, 0, height], [1, 0, height], [0, 1, height]])
        faces = torch.tensor([[0, 1, 2]])
        return {"vertices": corners, "faces": faces, "objective": torch.tensor(objective)}

    saved = {
        "open-blurred-0": stage(2.0, 0.0),
        "open-blurred-1": stage(1.0, 1.0),
        "levels-planes-0": stage(3.0, 2.0),
        "levels-blurred-0": stage(4.0, 3.0),
    }
    best = module.best_of(saved)
    assert {name: mesh.vertices[0, 2] for name, mesh in best.items()} == {
        "open": 1.0,
        "levels": 2.0,
    }
