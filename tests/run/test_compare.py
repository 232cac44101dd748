# SPDX-License-Identifier: MIT
"""What is heard in one run and not in the other is found where it is."""

from __future__ import annotations

import json
import shutil

import numpy as np
import pytest
from PIL import Image

from sononerf.errors import IncompatibleError, InputError, SettingsError
from sononerf.field.checkpoint_io import load_weights, save_weights
from sononerf.progress import Progress
from sononerf.run.compare import compare_runs
from sononerf.settings.loading import validate_settings

RADIUS = 0.02  # of the sphere that the fitted run heard

pytestmark = pytest.mark.usefixtures("without_pictures")


@pytest.fixture
def run(fitted_run, tmp_path):
    """Copy the fitted run under a name, with other settings, or its field silenced."""

    def make(name, *, gain=None, **sections):
        path = tmp_path / name
        path.mkdir()
        for file in ("model.safetensors", "model.json"):
            shutil.copy(fitted_run / file, path)
        state, description = load_weights(path)
        if gain is not None:
            state["renderer.log_gain"] += np.log(gain)
        plain = description["settings"]
        for section, values in sections.items():
            plain[section] = {**plain[section], **values}
        description["settings"] = validate_settings(plain, name).plain()
        save_weights(path, state, description)
        return path

    return make


def numbers(folder):
    return json.loads((folder / "comparison.json").read_text())


@pytest.mark.slow
def test_a_run_does_not_differ_from_its_copy(run):
    one = run("one")
    # What is true of their scenes makes no difference to what is heard.
    folder = compare_runs(one, run("same", scene={"options": {"radius": 0.01}}), accelerator="cpu")
    assert folder == one / "compare-same"
    found = numbers(folder)
    assert found["score"] == 0
    assert found["strongest_m"] is found["distance_m"] is None
    assert found["added_m"] is not None
    assert (found["first"], found["second"]) == ("one", "same")
    assert found["poses"] == 8  # that both were trained on, once


def test_what_only_the_first_hears_is_found(run, tmp_path):
    one = run("one")
    silent = run("silent", gain=1e-6, scene={"options": {"radius": 0.01}})
    folder = compare_runs(one, silent, output=tmp_path / "out", accelerator="cpu")
    found = numbers(folder)
    assert found["score"] == pytest.approx(1.0, abs=2e-3)  # the renderer's noise floor is left
    # Another sphere is all that is truly added; its middle is the origin.
    np.testing.assert_allclose(found["added_m"], 0, atol=1e-6)
    assert found["distance_m"] == pytest.approx(np.linalg.norm(found["strongest_m"]))
    assert found["distance_m"] < 2 * RADIUS
    for name in ("mip_x.png", "mip_y.png", "mip_z.png", "overlay.png"):
        with Image.open(folder / name) as image:
            assert min(image.size) > 100
    for name in ("first.vti", "second.vti", "difference.vti"):
        assert (folder / name).stat().st_size > 1000


@pytest.mark.slow
def test_runs_that_look_turned_round_are_said_to_be(run, tmp_path, caplog):
    one, silent = run("one"), run("silent", gain=1e-6)
    for first, second in ((one, silent), (silent, one)):
        folder = tmp_path / f"{first.name}-first"
        caplog.clear()
        compare_runs(first, second, output=folder, accelerator="cpu", progress=Progress(quiet=True))
        score, said = numbers(folder)["score"], caplog.text
        if first is one:
            assert score > 0.99
            assert "runs look swapped" not in said
        else:
            assert score < 1e-3
            assert "the second run has up to 1.00 of the maximum that the first has not" in said
            assert "runs look swapped" in said


@pytest.mark.slow
def test_poses_of_both_runs_are_listened_from(run):
    other = run("other", poses={"seed": 5})
    found = numbers(compare_runs(run("one"), other, accelerator="cpu"))
    assert found["poses"] == 16
    assert found["added_m"] is found["distance_m"] is None  # the scenes are alike


def test_runs_that_hear_differently_are_refused(run, tmp_path):
    other = run("other", air={"relative_humidity": 0.2})
    with pytest.raises(IncompatibleError, match=r"hear differently \(air\.relative_h") as caught:
        compare_runs(run("one"), other, output=tmp_path / "out", accelerator="cpu")
    assert "\n" not in str(caught.value)
    assert not (tmp_path / "out").exists()


def test_the_same_run_twice_is_refused(run, tmp_path):
    one = run("one")
    (tmp_path / "link").symlink_to(one)
    with pytest.raises(SettingsError, match=r"one and \S*link are the same run; give as") as caught:
        compare_runs(one, tmp_path / "link", output=tmp_path / "out", accelerator="cpu")
    assert "\n" not in str(caught.value)
    assert not (tmp_path / "out").exists()


def test_a_folder_without_a_run_is_refused(run, tmp_path):
    with pytest.raises(InputError, match="no fitted run"):
        compare_runs(run("one"), tmp_path / "nowhere", accelerator="cpu")
