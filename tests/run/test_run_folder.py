# SPDX-License-Identifier: MIT
"""What lies in a run's folder, and what may not be put there."""

from __future__ import annotations

import json
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

import sononerf as sn
from sononerf.errors import IncompatibleError, InputError, SettingsError
from sononerf.progress import Progress
from sononerf.run.build import differing_keys
from sononerf.run.doctor import as_plain, examine
from sononerf.run.predict import predict
from sononerf.run.reconstruct import reconstruct
from sononerf.run.run import Run
from sononerf.settings.loading import dump_yaml, load_settings


@pytest.fixture
def begun(tiny, tmp_path):
    path = tmp_path / "run"
    path.mkdir()
    begun = Run(path)
    begun.begin_fit(tiny())
    return begun


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


def test_a_run_holds_its_settings_whole(begun, tiny):
    assert begun.open() == tiny()
    assert load_settings(begun.config) == tiny()
    assert begun.config.read_text() == dump_yaml(tiny())


def test_the_same_settings_begin_it_again_and_others_do_not(begun, tiny):
    begun.begin_fit(tiny())
    with pytest.raises(IncompatibleError, match=r"\(fit\.seed\).*--output.*--overwrite"):
        begun.begin_fit(tiny(fit={"seed": 9}))
    many = tiny(
        poses={"count": 9, "radius": 0.5, "seed": 1, "heldout": 1}, fit={"seed": 9, "epochs": 1}
    )
    with pytest.raises(IncompatibleError, match=r"poses\.radius, \.\.\.\)"):
        begun.begin_fit(many)
    assert begun.open() == tiny()


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


def test_damaged_settings_of_a_run_are_told(begun, tiny):
    begun.config.write_text("fit: [")
    with pytest.raises(SettingsError, match=r"config\.yaml"):
        begun.begin_fit(tiny())


def test_sections_of_the_metrics_do_not_touch_each_other(begun):
    begun.write_metrics("cost", {"steps": 1})
    begun.write_metrics("cost", {"fit_s": 2.0}, merge=True)
    begun.write_metrics("geometry", None)
    assert begun.read_metrics() == {
        "schema": 1,
        "cost": {"steps": 1, "fit_s": 2.0},
        "geometry": None,
    }
    begun.write_metrics("geometry", {"level": 1.0}, merge=True)
    begun.write_metrics("cost", {"steps": 3})
    assert json.loads(begun.metrics_file.read_text()) == {
        "schema": 1,
        "cost": {"steps": 3},
        "geometry": {"level": 1.0},
    }


def test_metrics_that_are_none(begun):
    begun.metrics_file.write_text("[1]")
    with pytest.raises(InputError, match="holds no metrics"):
        begun.read_metrics()


def test_moving_aside_keeps_what_was_there(begun, tiny):
    (begun.path / "epochs").mkdir()
    aside = begun.move_aside()
    assert aside.name == "run.old-1"
    assert Run(aside).open() == tiny()
    assert not begun.path.exists()


QUIET = Progress(quiet=True)


def test_an_opened_run_has_its_parts(run, no_projections):
    predict(run, accelerator="cpu", pictures=0)
    reconstruct(run, spacing=0.008, accelerator="cpu")
    opened = sn.open_run(run)
    assert opened.path == run
    assert len(opened.echoes) == 12
    assert opened.head is opened.model.head
    assert opened.metrics["prediction"]["poses"] == 2
    assert "prediction mae_db" in str(opened.metrics)
    assert len(opened.surface.confidence) == len(opened.surface.mesh.vertices)
    assert "mae_db" in opened._repr_html_()
    heard = opened.predict(opened.echoes.poses("test"), progress=QUIET)
    stored = np.load(run / "prediction" / "spectrograms.npz")
    np.testing.assert_array_equal(heard.magnitude, stored["predicted"])
    numbers = sn.compare(heard, opened.echoes)
    assert numbers["mae_db"] == pytest.approx(opened.metrics["prediction"]["mae_db"])


def test_what_is_no_run_is_refused(tmp_path, run):
    with pytest.raises(InputError, match="no fitted run"):
        sn.open_run(tmp_path)
    with pytest.raises(InputError, match="there is no surface"):
        sn.open_run(run).surface  # noqa: B018
    with pytest.raises(InputError, match="expected a Prediction and Echoes, or two runs"):
        sn.compare(sn.open_run(run), 3)


def by_name(findings):
    return {finding.name: finding for finding in findings}


def test_the_machine_of_the_tests_can_do_all(tmp_path):
    found = by_name(examine(tmp_path))
    assert {"python", "cpu", "memory", "torch", "gpu", "ray casting", "disk"} < set(found)
    assert all(finding.good for finding in found.values())
    assert found["disk"].value.endswith("writes and locks work")
    assert not list(tmp_path.iterdir())
    plain = json.loads(json.dumps(as_plain(list(found.values()))))
    assert plain["good"] is True
    assert plain["findings"][0]["name"] == "python"


SMOKE = Path(__file__).parents[2] / "configs" / "smoke.yaml"


@pytest.mark.slow
def test_two_devices_fit_what_one_fits(tmp_path):
    found = []
    for devices in ("1", "2"):
        folder = f"run-{devices}"
        command = [sys.executable, "-m", "sononerf.cli", "fit", str(SMOKE), "--output", folder]
        command += ["--accelerator", "cpu", "--devices", devices]
        done = subprocess.run(command, cwd=tmp_path, capture_output=True, text=True, timeout=300)
        assert done.returncode == 0, done.stderr
        found.append(json.loads((tmp_path / folder / "metrics.json").read_text())["prediction"])
    one, two = found
    # Sums over half batches round differently; 120 steps of Adam let that grow, here to 0.02 dB.
    # What is traced off the mesh of so short a fit hangs on where its surface is torn.
    assert two["rendered_mae_db"] == pytest.approx(one["rendered_mae_db"], abs=0.1)
    assert two["mae_db"] < 0.7 * two["mean_predictor_mae_db"]
