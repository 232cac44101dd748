# SPDX-License-Identifier: MIT
"""What lies in a run's folder, and what may not be put there."""

from __future__ import annotations

import json

import pytest

from sononerf.errors import IncompatibleError, InputError, SettingsError
from sononerf.run.build import differing_keys
from sononerf.run.run import Run
from sononerf.settings.loading import dump_yaml, load_settings


@pytest.fixture
def run(tiny, tmp_path):
    path = tmp_path / "run"
    path.mkdir()
    run = Run(path)
    run.begin_fit(tiny())
    return run


def test_keys_that_differ_are_named_and_those_that_move_nothing_are_not(tiny):
    base = tiny()
    assert differing_keys(base, tiny()) == []
    changed = tiny(
        data={"workers": 2, "store": "elsewhere"},
        fit={"checkpoint_seconds": 1, "seed": 3},
        field={"options": {"levels": 1}},
    )
    assert differing_keys(base, changed) == [
        "field.options.finest",
        "field.options.levels",
        "fit.seed",
    ]


def test_a_run_holds_its_settings_whole(run, tiny):
    assert run.open() == tiny()
    assert load_settings(run.config) == tiny()
    assert run.config.read_text() == dump_yaml(tiny())


def test_the_same_settings_begin_it_again_and_others_do_not(run, tiny):
    run.begin_fit(tiny())
    with pytest.raises(IncompatibleError, match=r"\(fit\.seed\).*--output.*--overwrite"):
        run.begin_fit(tiny(fit={"seed": 9}))
    many = tiny(
        poses={"count": 9, "radius": 0.5, "seed": 1, "heldout": 1}, fit={"seed": 9, "epochs": 1}
    )
    with pytest.raises(IncompatibleError, match=r"poses\.radius, \.\.\.\)"):
        run.begin_fit(many)
    assert run.open() == tiny()


def test_a_folder_of_something_else_is_refused(tiny, tmp_path):
    (tmp_path / ".hidden").write_text("no matter")
    Run(tmp_path).check(tiny())
    (tmp_path / "thesis.tex").write_text("mine")
    with pytest.raises(InputError, match=r"holds 'thesis\.tex' and is no run"):
        Run(tmp_path).begin_fit(tiny())
    assert not (tmp_path / "config.yaml").exists()


def test_no_run(tmp_path):
    with pytest.raises(InputError, match="no run"):
        Run(tmp_path).open()
    assert Run(tmp_path / "nowhere").move_aside() is None


def test_damaged_settings_of_a_run_are_told(run, tiny):
    run.config.write_text("fit: [")
    with pytest.raises(SettingsError, match=r"config\.yaml"):
        run.begin_fit(tiny())


def test_sections_of_the_metrics_do_not_touch_each_other(run):
    run.write_metrics("cost", {"steps": 1})
    run.write_metrics("cost", {"fit_s": 2.0}, merge=True)
    run.write_metrics("geometry", None)
    assert run.read_metrics() == {"schema": 1, "cost": {"steps": 1, "fit_s": 2.0}, "geometry": None}
    run.write_metrics("geometry", {"level": 1.0}, merge=True)
    run.write_metrics("cost", {"steps": 3})
    assert json.loads(run.metrics_file.read_text()) == {
        "schema": 1,
        "cost": {"steps": 3},
        "geometry": {"level": 1.0},
    }


def test_metrics_that_are_none(run):
    run.metrics_file.write_text("[1]")
    with pytest.raises(InputError, match="holds no metrics"):
        run.read_metrics()


def test_moving_aside_keeps_what_was_there(run, tiny):
    (run.path / "epochs").mkdir()
    aside = run.move_aside()
    assert aside.name == "run.old-1"
    assert Run(aside).open() == tiny()
    assert not run.path.exists()
