# SPDX-License-Identifier: MIT
"""What is heard in one run and not in the other is found where it is."""

from __future__ import annotations

import functools
import json
import shutil

import numpy as np
import pytest
import trimesh
from PIL import Image

from sononerf.errors import IncompatibleError, InputError, NumericalError, SettingsError
from sononerf.evaluation import baseline
from sononerf.evaluation import numbers as geometry_module
from sononerf.field.checkpoint_io import load_weights, save_weights
from sononerf.progress import Progress
from sononerf.run.evaluate import compare_runs, evaluate
from sononerf.run.reconstruct import reconstruct
from sononerf.settings.loading import validate_settings

RADIUS = 0.02  # of the sphere that the fitted run heard

pytestmark = pytest.mark.usefixtures("without_pictures")


@pytest.fixture
def run_of(fitted_run, tmp_path):
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
def test_a_run_does_not_differ_from_its_copy(run_of):
    one = run_of("one")
    # What is true of their scenes makes no difference to what is heard.
    folder = compare_runs(
        one, run_of("same", scene={"options": {"radius": 0.01}}), accelerator="cpu"
    )
    assert folder == one / "compare-same"
    found = numbers(folder)
    assert found["score"] == 0
    assert found["strongest_m"] is found["distance_m"] is None
    assert found["added_m"] is not None
    assert (found["first"], found["second"]) == ("one", "same")
    assert found["poses"] == 8  # that both were trained on, once


def test_what_only_the_first_hears_is_found(run_of, tmp_path):
    one = run_of("one")
    silent = run_of("silent", gain=1e-6, scene={"options": {"radius": 0.01}})
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
def test_runs_that_look_turned_round_are_said_to_be(run_of, tmp_path, caplog):
    one, silent = run_of("one"), run_of("silent", gain=1e-6)
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
def test_poses_of_both_runs_are_listened_from(run_of):
    other = run_of("other", poses={"seed": 5})
    found = numbers(compare_runs(run_of("one"), other, accelerator="cpu"))
    assert found["poses"] == 16
    assert found["added_m"] is found["distance_m"] is None  # the scenes are alike


def test_runs_that_hear_differently_are_refused(run_of, tmp_path):
    other = run_of("other", air={"relative_humidity": 0.2})
    with pytest.raises(IncompatibleError, match=r"hear differently \(air\.relative_h") as caught:
        compare_runs(run_of("one"), other, output=tmp_path / "out", accelerator="cpu")
    assert "\n" not in str(caught.value)
    assert not (tmp_path / "out").exists()


def test_the_same_run_twice_is_refused(run_of, tmp_path):
    one = run_of("one")
    (tmp_path / "link").symlink_to(one)
    with pytest.raises(SettingsError, match=r"one and \S*link are the same run; give as") as caught:
        compare_runs(one, tmp_path / "link", output=tmp_path / "out", accelerator="cpu")
    assert "\n" not in str(caught.value)
    assert not (tmp_path / "out").exists()


def test_a_folder_without_a_run_is_refused(run_of, tmp_path):
    with pytest.raises(InputError, match="no fitted run"):
        compare_runs(run_of("one"), tmp_path / "nowhere", accelerator="cpu")


GEOMETRY = {
    "chamfer_m",
    "fscore",
    "thickness_bias_m",
    "volume_ratio",
    "iou",
    "normal_consistency",
    "components",
    "components_true",
    "level",
}


@pytest.fixture
def few_samples(monkeypatch):
    """A hundred thousand samples of each surface are for the reports, and so are pictures."""
    metrics = functools.partial(geometry_module.geometry_metrics, samples=2000)
    monkeypatch.setattr(geometry_module, "geometry_metrics", metrics)
    of_target = functools.partial(geometry_module.target_metrics, samples=2000)
    monkeypatch.setattr(geometry_module, "target_metrics", of_target)
    monkeypatch.setattr(geometry_module, "BASELINE_VOXELS", 24)
    monkeypatch.setattr(baseline, "LEVEL_SAMPLES", 300)


def test_what_is_evaluated(run, few_samples):
    metrics = evaluate(run)  # reconstructs where that was not done
    assert (run / "reconstruction" / "mesh.ply").is_file()
    assert metrics == json.loads((run / "metrics.json").read_text())
    assert metrics["geometry"].keys() == GEOMETRY
    assert metrics["geometry"]["fscore"].keys() == {"0.001", "0.002", "0.005"}
    assert metrics["geometry"]["components_true"] == 1
    assert metrics["baseline"].keys() == {"backprojection", "voxels"}
    for name in ("backprojection", "voxels"):
        assert metrics["baseline"][name].keys() == GEOMETRY, name


@pytest.mark.slow
def test_another_mesh_takes_the_numbers_of_the_last_one_away(
    run, tmp_path, few_samples, no_projections
):
    first = evaluate(run)
    reconstruct(run, spacing=0.012, output=tmp_path / "aside")
    with pytest.raises(NumericalError):
        reconstruct(run, level=1e9)
    assert json.loads((run / "metrics.json").read_text()) == first
    for output in (None, run / "reconstruction"):
        reconstruct(run, spacing=0.012, output=output)
        left = json.loads((run / "metrics.json").read_text())
        assert left.keys() == first.keys() - {"geometry"}
        assert left["baseline"] == first["baseline"]  # which know no mesh
        again = evaluate(run)
        assert again.keys() == first.keys()
        assert again["geometry"]["chamfer_m"] != first["geometry"]["chamfer_m"]


def test_a_scene_that_is_not_installed_has_no_truth(run, few_samples):
    description = json.loads((run / "model.json").read_text())
    description["settings"]["scene"] = {"name": "theirs", "options": {}}
    (run / "model.json").write_text(json.dumps(description))
    metrics = evaluate(run)
    assert metrics["geometry"] is None
    assert metrics["baseline"] == {"backprojection": None, "voxels": None}
    with Image.open(run / "reconstruction" / "view.png") as image:
        assert min(image.size) > 50


@pytest.mark.parametrize("content", [b"", b"ply\nnonsense", b"\x00" * 100])
def test_a_damaged_mesh_is_told(run, content):
    (run / "reconstruction").mkdir()
    (run / "reconstruction" / "mesh.ply").write_bytes(content)
    with pytest.raises(InputError, match=r"mesh\.ply: .*reconstruct again"):
        evaluate(run)


@pytest.mark.slow
def test_a_true_surface_from_a_file_replaces_the_scene(run, few_samples, no_projections, tmp_path):
    sphere = trimesh.creation.icosphere(subdivisions=3, radius=0.03)
    sphere.export(tmp_path / "true.stl")
    plain = evaluate(run)["geometry"]["chamfer_m"]
    larger = evaluate(run, truth=tmp_path / "true.stl")["geometry"]["chamfer_m"]
    assert larger > plain + 0.002


@pytest.mark.slow
def test_a_registered_surface_is_judged_in_the_frame_of_the_truth(
    run, few_samples, no_projections, tmp_path
):
    evaluate(run)
    true = trimesh.load_mesh(run / "reconstruction" / "mesh.ply")
    true.apply_scale((2.0, 2.0, 2.0))
    true.apply_translation((0.3, 0.0, 0.0))
    true.export(tmp_path / "true.ply")
    found = evaluate(run, truth=tmp_path / "true.ply", registration="similarity")["geometry"]
    assert found["chamfer_m"] < 0.001
    assert found["registration"]["scale"] == pytest.approx(2.0, rel=0.02)
    assert found["registration"]["kind"] == "similarity"


@pytest.mark.slow
def test_a_truth_in_other_units_or_elsewhere_is_refused_before_the_work(
    run, few_samples, no_projections, tmp_path
):
    evaluate(run)
    before = (run / "metrics.json").read_bytes()
    sphere = trimesh.creation.icosphere(subdivisions=3, radius=20.0)
    sphere.export(tmp_path / "true.stl")
    with pytest.raises(InputError, match=r"true\.stl: .* across, .*--unit mm"):
        evaluate(run, truth=tmp_path / "true.stl")
    assert (run / "metrics.json").read_bytes() == before
    found = evaluate(run, truth=tmp_path / "true.stl", unit="mm")["geometry"]
    assert found["chamfer_m"] < 0.01
    sphere.apply_translation([300.0, 0.0, 0.0])
    sphere.export(tmp_path / "true.stl")
    with pytest.raises(InputError, match=r"true\.stl: lies 0\.2\d* m away .*--registration rigid"):
        evaluate(run, truth=tmp_path / "true.stl", unit="mm")
