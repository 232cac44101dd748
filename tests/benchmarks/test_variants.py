# SPDX-License-Identifier: MIT
"""The paper's settings as its published code has them, from metrics made by hand."""

from __future__ import annotations

import json
import re
import shlex
from argparse import Namespace
from pathlib import Path

import pytest

from sononerf.errors import SettingsError
from sononerf.run.build import check_plugins, head_of
from sononerf.settings.loading import load_settings
from tools.benchmarks import variants as module
from tools.benchmarks.paper import PAPER
from tools.benchmarks.variants import VARIANTS, row_of, table

PAGE = Path(__file__).resolve().parents[2] / "docs" / "paper.md"


def told():
    """The settings that the page gives for the published code's ways."""
    rows = [line for line in PAGE.read_text().splitlines() if line.startswith("| ")]
    found = [options for row in rows for options in re.findall(r"`([^`]+=[^`]+)`", row)]
    return {tuple(sorted(shlex.split(options))) for options in found}


def test_every_option_of_the_page_is_measured_and_every_measured_one_is_on_the_page():
    measured = {tuple(sorted(v.settings)) for v in VARIANTS if v.settings}
    not_a_fit = {
        ("fit.epochs=150",),  # the length itself
        ("reconstruction.spacing=0.0005",),  # hours of reading out
        ("reconstruction.level=NUMBER",),  # of one's own
    }
    assert measured == told() - not_a_fit


@pytest.mark.parametrize("variant", VARIANTS, ids=lambda variant: variant.name)
def test_each_is_the_paper_but_for_one_thing(variant, quick_ears):
    settings = load_settings(PAPER, variant.settings)
    check_plugins(settings, head_of(settings))
    assert (settings == load_settings(PAPER)) == (variant.name == "paper")


METRICS = {
    "cost": {"fit_s": 200.0, "steps": 6840},
    "prediction": {
        "mae_db": 1.0,
        "rendered_mae_db": 2.1,
        "rendered_mae_db_active": 9.5,
        "mean_predictor_mae_db": 2.2,
        "mean_predictor_mae_db_active": 9.2,
    },
    "geometry": {"fscore": {"0.005": 0.25}, "chamfer_m": 0.0046, "components": 4},
}


def series(monkeypatch, output, fail=()):
    asked = []

    def experiment(folder, data, settings, *, config, enough):
        asked.append((folder, data, list(settings), config, enough))
        if folder.name in fail:
            raise fail[folder.name]
        return METRICS

    monkeypatch.setattr(module, "run_experiment", experiment)
    chosen = {"scene": "ua", "epochs": 7, "set": ["poses.heldout=2"], "data": None}
    return asked, module.variants(Namespace(output=output, **chosen))


def test_each_is_fitted_for_as_long_on_the_same_scene(monkeypatch, tmp_path):
    asked, text = series(monkeypatch, tmp_path)
    own = ["scene.name=ua", "fit.epochs=7", "poses.heldout=2"]
    assert [settings for _, _, settings, _, _ in asked] == [[*own, *v.settings] for v in VARIANTS]
    assert [folder for folder, *_ in asked] == [tmp_path / v.name for v in VARIANTS]
    same = (tmp_path / "data", PAPER, "prediction")
    assert all((data, *rest) == same for _, data, _, *rest in asked)
    kept = json.loads((tmp_path / "variants.json").read_text())
    assert [row["name"] for row in kept["rows"]] == [v.name for v in VARIANTS]
    assert "variants.json" in text


def test_what_is_traced_off_the_mesh_is_left_out():
    row = row_of(METRICS)
    assert (row["mae_db"], row["mae_db_active"], row["chamfer_m"]) == (2.1, 9.5, 0.0046)
    line = table([{"name": "loss", **row}]).splitlines()[1].split()
    assert line == ["loss", "6840", "200", "2.10", "2.20", "9.50", "9.20", "0.25", "4.6"]


def test_one_that_fails_is_told_of_and_the_others_go_on(monkeypatch, tmp_path):
    asked, text = series(
        monkeypatch, tmp_path, fail={"loss": RuntimeError("exit code 3: no surface")}
    )
    assert len(asked) == len(VARIANTS)
    assert "loss: exit code 3: no surface" in text
    row = next(line.split() for line in text.splitlines() if line.split()[0] == "loss")
    assert row == ["loss", *["-"] * 8]


def test_a_scene_without_what_a_variant_changes_has_the_others(monkeypatch, tmp_path):
    unknown = SettingsError("scene.options.radius: unknown")
    asked, text = series(monkeypatch, tmp_path, fail={"28.6-mm": unknown})
    assert len(asked) == len(VARIANTS)
    assert "28.6-mm: scene.options.radius: unknown" in text


def test_settings_that_are_wrong_for_all_end_it(monkeypatch, tmp_path):
    with pytest.raises(SystemExit, match="unknown scene"):
        series(monkeypatch, tmp_path, fail={"paper": SettingsError("unknown scene 'nosuch'")})


def test_a_run_without_a_surface_has_no_geometry():
    row = row_of({"cost": METRICS["cost"], "prediction": METRICS["prediction"]})
    assert row["fscore_5mm"] is None
    assert row["mae_db"] == 2.1
