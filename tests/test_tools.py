# SPDX-License-Identifier: MIT
"""The tools of developers: tables of benchmarks, and what the start network learns from."""

from __future__ import annotations

import argparse
import json
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
import torch
import trimesh

from sononerf.errors import InputError
from sononerf.geometry.lattice import Lattice
from sononerf.settings.loading import load_settings
from sononerf.start.features import FEATURES
from sononerf.start.network import StartNetwork
from tools.benchmarks import exact, foreign
from tools.benchmarks.experiment import CONFIG
from tools.benchmarks.results_page import write_page
from tools.benchmarks.step import PAIRS
from tools.benchmarks.surfaces import CASES, chosen_cases, measured, table
from tools.learning.bodies import KINDS, body
from tools.learning.examples import true_distance
from tools.learning.training import train

ROOT = Path(__file__).resolve().parent.parent
RADIUS = 0.02
METRICS = {
    "cost": {"simulate_s": 60.0, "fit_s": 41.0, "reconstruct_s": 9.0, "steps": 1340},
    "prediction": {"mae_db": 0.4, "mae_db_active": 1.4, "rendered_mae_db_active": 3.4},
    "geometry": {
        "chamfer_m": 0.00091,
        "fscore": {"0.001": 0.62, "0.002": 0.99, "0.005": 1.0},
        "thickness_bias_m": 0.0008,
        "components": 2,
        "components_true": 3,
    },
    "baseline": {},
}
LINE = {
    "chamfer_m": 0.00091,
    "fscore_1mm": 0.62,
    "fscore_2mm": 0.99,
    "fscore_5mm": 1.0,
    "thickness_bias_m": 0.0008,
    "parts": 2,
    "parts_true": 3,
    "heldout_mae_db_active": 1.4,
    "heldout_mae_db": 0.4,
    "rendered_mae_db_active": 3.4,
    "seconds": 50.0,
    "simulate_s": 60.0,
}


@pytest.mark.parametrize("case", CASES, ids=lambda case: case.name)
def test_the_settings_of_each_case_are_known(case):
    load_settings(CONFIG.with_name(f"{case.config}.yaml"), case.settings)


def test_named_scenes_are_fitted_with_every_seed_and_exact_echoes_where_they_are_given():
    found = list(chosen_cases(None, [5, 6], exact=False))
    seeds = {name: [seed for case, seed in found if case.name == name] for name in ("ua", "cone")}
    assert seeds == {"ua": [5, 6], "cone": [5]}
    assert "exact" not in {case.name for case, _ in found}
    assert "exact" in {case.name for case, _ in chosen_cases(None, [5], exact=True)}
    assert [case.name for case, _ in chosen_cases(["cone"], [5], exact=True)] == ["cone"]
    with pytest.raises(SystemExit, match="--exact"):
        list(chosen_cases(["exact"], [5], exact=False))


def test_a_line_tells_of_surface_prediction_and_time():
    assert measured(METRICS) == LINE
    assert measured({"prediction": None}) == dict.fromkeys(LINE)
    # Whatever stage comes between fit and surface counts.
    more = {"cost": {"fit_s": 1.0, "refine_s": 20.0, "reconstruct_s": 300.0, "simulate_s": 4000.0}}
    assert measured(more)["seconds"] == 321.0


REFINED = {
    "starts": {"levels": {"fscore_2mm": 0.5}},
    "result": {"fscore_2mm": 0.8, "fscore_5mm": 1, "chamfer_m": 1e-3, "parts": 1, "parts_true": 2},
    "chosen": "levels",
    "kept": False,
}


def rows():
    plain = {**LINE, "seed": 0}
    bad = {"chamfer_m": 0.004, "fscore_2mm": 0.5, "seconds": 99.0}
    return [
        {**plain, "name": "stool", **bad, "failed": "no surface"},
        {**plain, "name": "procedural-101", "fscore_2mm": 0.8},
        {**plain, "name": "procedural-100", **bad},
        {**plain, "name": "procedural-102"},
        {**plain, "name": "ua", "chamfer_m": 4.2e-5, "seed": 2},
        {"name": "helix", "seed": 0, "failed": "no echo"},
    ]


def test_the_table_is_in_order_with_medians_and_worst_values():
    lines = table(rows()).splitlines()
    assert lines[0].split()[:4] == ["name", "seed", "Chamfer/mm", "F"]
    assert lines[1].split() == "ua 2 0.042 0.62 0.99 1.00 2 3 3.40 1.40 50".split()
    assert [line.split()[0] for line in lines[2:7]] == [
        *(f"procedural-{seed}" for seed in (100, 101, 102)),
        "stool",
        "helix",
    ]
    assert lines[5].endswith("99  failed: no surface")
    assert lines[6].split()[:3] == ["helix", "0", "-"]
    assert lines[7].split() == "procedural, median 0.910 0.62 0.80 1.00 3.40 1.40 50".split()
    assert lines[8].split() == "procedural, worst 4.000 0.62 0.50 1.00 3.40 1.40 99".split()
    assert lines[9].split()[:4] == ["new", "scenes,", "median", "4.000"]
    assert len(lines) == 11


@pytest.mark.slow
def test_a_case_is_fitted_once_and_leaves_a_line(tmp_path):
    few = ["poses.count=12", "poses.validation=2", "poses.heldout=2", "fit.epochs=1"]
    few += ["simulation.rays=500", "reconstruction.refine=false", "scene.options.radius=0.02"]
    command = [sys.executable, "tools/benchmark.py", "surfaces", "--only", "three-times-as-large"]
    for _ in range(2):  # the second time all is there
        said = subprocess.run(
            [*command, "--output", tmp_path, "--set", *few],
            cwd=ROOT, capture_output=True, text=True, check=True,
        ).stdout  # fmt: skip
        assert said.splitlines()[1].split()[:2] == ["three-times-as-large", "0"]
    (line,) = (tmp_path / "surfaces.jsonl").read_text().splitlines()
    assert json.loads(line)["chamfer_m"] > 0


def score(value):
    return {"chamfer_m": 0.002 - 0.001 * value, "fscore_2mm": value, "fscore_5mm": 1.0} | {
        "parts": 2,
        "parts_true": 1,
    }


def row(name, levels, other, result, calls=400):
    return {
        "name": name,
        "calls": calls,
        "starts": {"fuller": score(0.5), "levels": score(levels)},
        "refined": {"fuller": score(other), "levels": score(levels + 0.1)},
        "result": score(result),
        "chosen": "levels",
        "kept": result != levels,
        "surface_s": 60.0,
    }


def test_the_table_shows_starts_candidates_and_result_and_what_a_right_choice_would_give():
    rows = [row("a", 0.7, 0.9, 0.8), row("b", 0.6, 0.4, 0.6), row("c", 0.2, 0.1, 0.3, calls=25)]
    lines = [line.split() for line in foreign.table(rows).splitlines() if line]
    first, second, median, least = lines[1:5]
    # levels, fuller; refined the same; best, result, F 5mm, mm, parts, true, s, chosen
    assert first[:5] == ["a", "0.70", "0.50", "0.80", "0.90"]
    assert first[5:] == ["0.90", "0.80", "1.00", "1.20", "2", "1", "60", "levels"]
    assert second[-2:] == ["levels,", "unrefined"]
    assert median[:3] == ["median", "0.65", "0.50"]
    assert least[:3] == ["least", "0.60", "0.50"]
    assert [line[0] for line in lines].count("c") == 1
    assert [line[:2] for line in lines if line[1] == "calls"] == [["400", "calls"], ["25", "calls"]]


def test_the_page_names_commits_and_has_all_numbers_of_calls(tmp_path):
    other = {"name": "randoma", "calls": 400, "commit": "abc", "machine": "m", **REFINED}
    lines = [other, {**other, "name": "randomb", "calls": 25}]
    text = "\n".join(json.dumps(line) for line in lines)
    (tmp_path / "foreign.jsonl").write_text(text)
    page, readme = tmp_path / "results.md", tmp_path / "README.md"
    write_page(tmp_path, page, readme)
    assert "commit abc" in page.read_text()
    assert "2 closed bodies" in page.read_text()
    assert "| **result** | **0.80 · 0.80 · 0.80** | **0.80 · 0.80 · 0.80** |" in page.read_text()
    assert "--calls 400 25\n" in page.read_text()
    assert "| a | 0.50 | 0.80 | 1.00 mm | 1 (2) | `levels`, unrefined |" in page.read_text()
    (tmp_path / "foreign.jsonl").write_text(
        f"{text}\n{json.dumps({**other, 'commit': 'd', 'name': 'c'})}"
    )
    write_page(tmp_path, page, readme)
    assert "| c (commit d) | 0.50 |" in page.read_text()


def test_of_each_start_the_surface_with_the_lowest_objective_counts():
    def stage(objective, height):
        corners = torch.tensor([[0.0, 0, height], [1, 0, height], [0, 1, height]])
        faces = torch.tensor([[0, 1, 2]])
        return {"vertices": corners, "faces": faces, "objective": torch.tensor(objective)}

    saved = {
        "fuller-blurred-0": stage(2.0, 0.0),
        "fuller-blurred-1": stage(1.0, 1.0),
        "levels-planes-0": stage(3.0, 2.0),
        "levels-blurred-0": stage(4.0, 3.0),
    }
    best = foreign.best_of(saved)
    assert {name: mesh.vertices[0, 2] for name, mesh in best.items()} == {
        "fuller": 1.0,
        "levels": 2.0,
    }


RANGE = np.arange(0.3, 0.5, 0.001)
FREQUENCY = np.array([15e3, 30e3, 60e3])


def echo(quiet=1.0):
    """Return one pose and two ears: an echo at 0.4 m, its middle frequency weaker or not."""
    magnitude = np.full((1, 2, len(RANGE), 3), 1e-9)
    magnitude[:, :, 100:105] = [1.0, quiet, 1.0]
    return magnitude


def test_errors_are_by_band():
    low, middle, high = exact.errors(echo(0.5), echo(), FREQUENCY)
    assert low[0] == high[0] == 0.0
    assert middle[1] == pytest.approx(-6.02, abs=0.02)


def test_what_comes_early_is_told_apart_from_the_echo():
    nearest = np.full((1, 2), 0.4)
    assert exact.before(echo(), echo(), RANGE, nearest) < 0.01
    early = echo()
    early[0, 1, 80] = 1e-3  # 20 mm before the echo, 6 dB above m0
    assert exact.before(early, echo(), RANGE, nearest) == pytest.approx(6.02, abs=0.01)


@pytest.mark.slow
def test_the_table_has_a_row_for_each_body_and_engine():
    arguments = argparse.Namespace(bodies=["balls"], engines=["hybrid", "rays"], rays=3000)
    lines = exact.exact(arguments).splitlines()
    assert len(lines) == 4
    hybrid, rays = (float(line.split("|")[3].split("(")[0]) for line in lines[2:])
    assert hybrid < 0.5 < 5.0 < rays


def test_each_field_goes_through_each_renderer_with_settings_that_are_known():
    chosen = [load_settings(pair.config, pair.settings) for pair in PAIRS[1:]]
    kinds = {(settings.field.kind, settings.renderer.kind) for settings in chosen}
    assert kinds == {(f, r) for f in ("fourier", "grid") for r in ("shell", "profile")}


def test_without_examples_nothing_is_trained(tmp_path):
    with pytest.raises(InputError, match="no examples to train on"):
        train(tmp_path, steps=1, seed=0, tell=lambda line: None)


def test_a_new_network_adds_nothing_but_its_last_layer_to_the_bound():
    network = StartNetwork()
    with torch.no_grad():
        for part in network.leave[2].parameters():
            part.zero_()
        found = network(torch.zeros(1, FEATURES, 8, 8, 8), torch.full((1, 8, 8, 8), -1.5))
    np.testing.assert_allclose(found.numpy(), -1.5)


@pytest.mark.parametrize("seed", range(len(KINDS)))
def test_a_body_is_closed_and_that_of_its_seed(seed):
    kind, mesh = body(seed)
    assert kind == KINDS[seed].__name__
    assert mesh.is_watertight
    assert mesh.volume > 0
    np.testing.assert_array_equal(body(seed)[1].vertices, mesh.vertices)


def test_the_true_distance_is_negative_inside():
    lattice = Lattice.over(np.full(3, -0.03), np.full(3, 0.03), 0.002)
    found = true_distance(trimesh.creation.icosphere(4, RADIUS), lattice)
    expected = (np.linalg.norm(lattice.points(), axis=1) - RADIUS) / 0.002
    np.testing.assert_allclose(found.ravel(), np.minimum(expected, 6.0).clip(-6.0), atol=0.05)
