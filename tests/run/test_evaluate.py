# SPDX-License-Identifier: MIT
"""A run's surface and the baselines are compared with the truth, where it is known."""

from __future__ import annotations

import functools
import json

import pytest
import trimesh
from PIL import Image

from sononerf.errors import InputError, NumericalError
from sononerf.evaluation import baseline
from sononerf.evaluation import geometry as geometry_module
from sononerf.run.evaluate import evaluate
from sononerf.run.reconstruct import reconstruct

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
