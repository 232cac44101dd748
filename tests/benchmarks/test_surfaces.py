# SPDX-License-Identifier: MIT
"""The table of surfaces, from metrics made by hand; nothing is simulated or fitted here."""

from __future__ import annotations

import json
from argparse import Namespace
from pathlib import Path

import pytest

from sononerf.errors import IncompatibleError
from sononerf.scene.scene import load_scene
from sononerf.settings.loading import load_settings
from tools.benchmarks import surfaces as module
from tools.benchmarks.experiment import CONFIG
from tools.benchmarks.surfaces import CASES, NEW, PROCEDURAL, chosen_cases, measured, table

pytestmark = pytest.mark.thorough

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


@pytest.fixture
def asked(monkeypatch):
    """Experiments that end at once, as told by the name of their folder."""
    runs, ends = {}, {}

    def run_experiment(folder, data, settings, *, config, enough, store):
        assert enough == "prediction"  # a run without a surface has a line too
        load_settings(config, settings)
        runs[folder.name] = (data, list(settings), store)
        end = ends.get(folder.name, METRICS)
        if isinstance(end, BaseException):
            raise end
        return end

    monkeypatch.setattr(module, "run_experiment", run_experiment)
    return runs, ends


def arguments(output, **changed):
    plain = {"only": None, "seeds": [0, 1], "exact": None, "data": None, "set": ["fit.epochs=1"]}
    return Namespace(foreign=None, **{**plain, "output": output, **changed})


def written(output):
    return [json.loads(line) for line in (output / "surfaces.jsonl").read_text().splitlines()]


@pytest.mark.slow
def test_all_that_the_table_asks_for_is_there_and_its_settings_are_known():
    names = [case.name for case in CASES]
    assert len(set(names)) == len(names)
    assert {"three_spheres", "ua", "leaf", *NEW} < set(names)
    assert {f"procedural-{seed}" for seed in range(100, 120)} < set(names)
    assert len(PROCEDURAL) == 20
    for case in CASES:
        settings = load_settings(CONFIG.with_name(f"{case.config}.yaml"), case.settings)
        if not case.name.startswith("procedural"):
            load_scene(settings.scene.name, settings.scene.options)


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


def test_each_run_leaves_a_line_and_is_not_made_twice(asked, tmp_path):
    runs, _ = asked
    text = module.surfaces(arguments(tmp_path, only=["leaf", "25-calls"]))
    assert text.endswith(f"wrote {tmp_path / 'surfaces.jsonl'}")
    assert list(runs) == ["leaf-0", "leaf-1", "25-calls-0"]
    scene = ["scene.name=three_spheres", "poses.count=25", "fit.epochs=1", "fit.seed=0"]
    assert runs["25-calls-0"] == (tmp_path / "data", scene, None)
    lines = written(tmp_path)
    assert [(line["name"], line["seed"]) for line in lines] == [
        ("leaf", 0),
        ("leaf", 1),
        ("25-calls", 0),
    ]
    assert LINE.items() <= lines[2].items()
    assert lines[2]["settings"] == scene
    assert {"sononerf", "machine"} < set(lines[2])
    runs.clear()
    # The next one goes on where this one stopped, also behind a line that a crash tore.
    with (tmp_path / "surfaces.jsonl").open("a") as file:
        file.write('{"name": "cone", "se')
    module.surfaces(arguments(tmp_path, only=["leaf", "25-calls", "cone"], data=Path("d")))
    assert list(runs) == ["cone-0"]
    assert runs["cone-0"][0] == Path("d")


def test_other_settings_are_another_line_and_the_last_one_counts(asked, tmp_path):
    _, ends = asked
    module.surfaces(arguments(tmp_path, only=["cone"]))
    ends["cone-0"] = {**METRICS, "cost": {"fit_s": 777.0}}
    text = module.surfaces(arguments(tmp_path, only=["cone"], set=[]))
    assert len(written(tmp_path)) == 2
    assert "777" in text
    assert len([line for line in text.splitlines() if line.lstrip().startswith("cone")]) == 1


def test_what_failed_is_told_and_tried_again(asked, tmp_path):
    _, ends = asked
    ends["cone-0"] = RuntimeError("exit code 5: no echo")
    ends["beaker-0"] = {**METRICS, "geometry": None}
    text = module.surfaces(arguments(tmp_path, only=["cone", "beaker"]))
    beaker, cone = written(tmp_path)
    assert cone["failed"] == "exit code 5: no echo"
    assert (beaker["failed"], beaker["rendered_mae_db_active"]) == ("no surface", 3.4)
    assert "failed: no surface" in text
    ends.clear()
    text = module.surfaces(arguments(tmp_path, only=["cone", "beaker"]))
    assert "failed:" not in text
    assert len(written(tmp_path)) == 4


@pytest.mark.parametrize(
    ("end", "said"), [(KeyboardInterrupt(), "goes on"), (IncompatibleError("other"), "other")]
)
def test_an_end_of_all_keeps_the_lines_so_far(asked, tmp_path, end, said):
    _, ends = asked
    ends["rings-0"] = end
    with pytest.raises(SystemExit, match=said):
        module.surfaces(arguments(tmp_path, only=["cone", "rings", "tower"]))
    assert [line["name"] for line in written(tmp_path)] == ["cone"]


def test_exact_echoes_are_read_from_the_store_that_is_given(asked, tmp_path):
    runs, _ = asked
    module.surfaces(arguments(tmp_path, only=["exact"], exact=Path("echoes")))
    assert runs["exact-0"][2] == Path("echoes")


@pytest.mark.slow
def test_the_scaled_world_is_made_of_the_unscaled_one_and_judged_in_its_metres(
    asked, monkeypatch, tmp_path
):
    runs, _ = asked
    made = []
    monkeypatch.setattr(module, "_simulate", lambda store, settings: made.append((store, settings)))
    monkeypatch.setattr(module, "scaled_store", lambda *given: made.append(given))
    # What is found is the truth, a tenth of a millimetre too large for the unscaled world.
    folder = tmp_path / "scaled-0" / "reconstruction"
    folder.mkdir(parents=True)
    found = load_scene("sphere", {"radius": 0.0453}).mesh
    found.export(folder / "mesh.ply")
    monkeypatch.setattr(module, "load_scene", lambda *_: load_scene("sphere", {"radius": 0.045}))
    module.surfaces(arguments(tmp_path, only=["scaled"]))
    (source, unscaled), (copied, target, settings, factor) = made
    assert unscaled == ["scene.name=three_spheres", "ears.notch_depth=0", "fit.epochs=1"]
    assert source == copied
    assert source.parent == target.parent == tmp_path / "data"
    assert runs["scaled-0"][2] == target != source
    assert (factor, settings.poses.radius) == (3.0, pytest.approx(1.2))
    (line,) = written(tmp_path)
    assert line["chamfer_m"] == pytest.approx(1e-4, rel=0.02)
    assert (line["fscore_1mm"], line["parts"], line["parts_true"]) == (1.0, 1, 1)
    assert (line["seconds"], line["heldout_mae_db_active"]) == (50.0, 1.4)


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
