# SPDX-License-Identifier: MIT
"""A fitted field becomes files, and numbers where the truth is known."""

from __future__ import annotations

import functools
import io
import json
import shutil

import numpy as np
import pytest
import trimesh
from PIL import Image

from sononerf.errors import InputError, NumericalError
from sononerf.experiment import reconstruct as reconstruct_module
from sononerf.experiment.build import point_echo
from sononerf.experiment.fit import fit
from sononerf.experiment.fitted import load_fitted
from sononerf.experiment.reconstruct import evaluate, reconstruct
from sononerf.progress import Progress
from sononerf.reconstruction import baseline
from sononerf.reconstruction import read_out as read_out_module
from sononerf.reconstruction.openness import Openness
from sononerf.reconstruction.read_out import Reconstruction
from sononerf.reconstruction.volume import Volume
from sononerf.scene import Scene

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


@pytest.fixture(scope="module")
def fitted(tiny_settings, without_pictures, tmp_path_factory):
    path = tmp_path_factory.mktemp("fitted") / "run"
    fit(tiny_settings(fit={"epochs": 10}), path, accelerator="cpu", workers=1)
    return path


@pytest.fixture
def run(fitted, tmp_path):
    path = tmp_path / "elsewhere"
    path.mkdir()
    for name in ("model.safetensors", "model.json"):
        shutil.copy(fitted / name, path)
    return path


@pytest.fixture
def few_samples(monkeypatch):
    """A hundred thousand samples of each surface are for the reports, and so are pictures."""
    metrics = functools.partial(reconstruct_module.geometry_metrics, samples=2000)
    monkeypatch.setattr(reconstruct_module, "geometry_metrics", metrics)
    of_target = functools.partial(reconstruct_module.target_metrics, samples=2000)
    monkeypatch.setattr(reconstruct_module, "target_metrics", of_target)
    monkeypatch.setattr(reconstruct_module, "BASELINE_VOXELS", 24)
    monkeypatch.setattr(baseline, "LEVEL_SAMPLES", 300)


@pytest.fixture
def no_projections(monkeypatch):
    monkeypatch.setattr(reconstruct_module, "mip_pngs", lambda volume: {})


def read_out(folder):
    return json.loads((folder / "read_out.json").read_text())


def test_every_file_is_there_and_readable(run):
    import pyvista

    folder = reconstruct(run)
    assert folder == run / "reconstruction"
    assert sorted(p.name for p in folder.iterdir()) == sorted(
        ["mesh.ply", "mesh.stl", "mesh.glb", "volume.vti", "view.png", "read_out.json"]
        + ["confidence.png"]
        + [f"mip_{axis}.png" for axis in "xyz"]
    )
    meshes = {kind: trimesh.load_mesh(folder / f"mesh.{kind}") for kind in ("ply", "stl", "glb")}
    faces = {len(mesh.faces) for mesh in meshes.values()}
    assert len(faces) == 1
    assert faces.pop() > 20
    for mesh in meshes.values():
        np.testing.assert_allclose(mesh.bounds, meshes["ply"].bounds, atol=1e-6)
    volume = pyvista.read(folder / "volume.vti")
    assert np.isfinite(volume.point_data.active_scalars).all()
    assert volume.spacing[0] == pytest.approx(read_out(folder)["spacing_m"])
    for picture in folder.glob("*.png"):
        with Image.open(io.BytesIO(picture.read_bytes())) as image:
            assert min(image.size) > 50
    assert json.loads((run / "metrics.json").read_text())["cost"]["reconstruct_s"] > 0


def test_spacing_and_level_are_obeyed(run, tmp_path, no_projections):
    coarse = reconstruct(run, spacing=0.012, output=tmp_path / "coarse")
    assert read_out(coarse)["method"] in ("open", "filled", "hull")
    assert read_out(coarse)["level"] is None
    fine = reconstruct(run, spacing=0.007, method="isosurface", output=tmp_path / "fine")
    assert read_out(coarse)["spacing_m"] == pytest.approx(0.012)
    assert read_out(fine)["spacing_m"] == pytest.approx(0.007)
    level = read_out(fine)["level"]
    other = reconstruct(run, spacing=0.007, level=level / 2, output=tmp_path / "low")
    assert read_out(other)["level"] == pytest.approx(level / 2)
    assert read_out(other)["method"] == "isosurface"
    assert not read_out(other)["refined"]
    assert (fine / "mesh.ply").read_bytes() != (other / "mesh.ply").read_bytes()
    same = reconstruct(run, spacing=0.007, level=level, output=tmp_path / "same")
    assert (fine / "mesh.ply").read_bytes() == (same / "mesh.ply").read_bytes()
    assert not (run / "metrics.json").exists()


@pytest.fixture
def judged(run, tmp_path, no_projections, monkeypatch):
    """Reconstruct a ball, judged as asked; return the folder and what was said."""
    ball = trimesh.creation.icosphere(subdivisions=2, radius=0.02)
    volume = Volume(np.zeros((2, 2, 2), np.float32), np.zeros(3), 0.01)

    def make(openness, **given):
        found = Reconstruction(ball, volume, None, "filled", openness)

        def noted(*field, **options):
            make.asked = options
            return found

        monkeypatch.setattr(reconstruct_module, "read_out", noted)
        monkeypatch.setattr(reconstruct_module, "side_by_side_png", lambda *meshes: b"")
        said = []
        progress = Progress(quiet=True)
        monkeypatch.setattr(progress, "say", said.append)
        name = "none" if openness is None else openness.kind
        return reconstruct(run, output=tmp_path / name, progress=progress, **given), said

    return make


def test_what_kind_of_surface_it_is_is_written_and_of_open_ones_it_is_said(judged):
    nothing = np.zeros(0, dtype=bool)
    folder, said = judged(Openness(nothing, unseen_share=0.384, thin_share=0.01))
    assert read_out(folder)["surface"] == "one-sided"
    assert said == ["the surface is open: 38% of it, which no pose heard, is left out"]
    folder, said = judged(Openness(nothing, unseen_share=0.02, thin_share=0.926))
    assert read_out(folder)["surface"] == "sheet"
    assert said == ["the surface is a sheet: 93% of it has its other side right behind it"]
    for openness, name in ((Openness(nothing, 0.02, 0.01), "closed"), (None, None)):
        folder, said = judged(openness)
        assert read_out(folder)["surface"] == name
        assert said == []


def test_the_surface_of_a_run_is_judged_by_its_own_poses(run, no_projections, monkeypatch):
    asked = []
    plain = read_out_module.judge_openness

    def judge(mesh, sources, *, resolution):
        asked.append(sources)
        assert resolution == point_echo(load_fitted(run).settings).resolution
        return plain(mesh, sources, resolution=resolution)

    monkeypatch.setattr(read_out_module, "judge_openness", judge)
    folder = reconstruct(run, spacing=0.012)
    np.testing.assert_allclose(asked[0], load_fitted(run).hull.sources)
    assert len(asked) == 1
    kind = read_out(folder)["surface"]
    assert kind in ("closed", "sheet", "one-sided")
    # Only what was heard from one side is cut open.
    assert trimesh.load_mesh(folder / "mesh.ply").is_watertight == (kind != "one-sided")


@pytest.mark.parametrize(
    ("settings", "given", "expected"),
    [
        ({}, {}, "filled"),
        ({"method": "open"}, {}, "open"),
        ({"method": "open"}, {"method": "hull"}, "hull"),
        ({"method": "open"}, {"level": 0.4}, "isosurface"),
        ({"level": 0.4}, {}, "isosurface"),
        ({"level": 0.4}, {"method": "hull"}, "hull"),
        ({"level": 0.4}, {"level": "auto"}, "filled"),
    ],
)
def test_what_the_caller_gives_replaces_the_settings(judged, run, settings, given, expected):
    description = json.loads((run / "model.json").read_text())
    description["settings"]["reconstruction"] |= settings
    (run / "model.json").write_text(json.dumps(description))
    judged(None, **given)
    assert judged.asked["method"] == expected
    assert judged.asked["level"] == (0.4 if expected == "isosurface" else "auto")


def test_a_level_above_everything_has_no_surface(run):
    with pytest.raises(NumericalError):
        reconstruct(run, level=1e9)


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


def test_what_needs_a_closed_surface_is_null_for_an_open_one(
    run, few_samples, no_projections, monkeypatch
):
    open_mesh = trimesh.creation.icosphere(subdivisions=3, radius=0.02)
    open_mesh.update_faces(np.arange(len(open_mesh.faces)) > 40)
    open_scene = Scene(open_mesh)
    monkeypatch.setattr(reconstruct_module, "load_scene", lambda *given: open_scene)
    geometry = evaluate(run)["geometry"]
    for key in ("volume_ratio", "iou", "thickness_bias_m"):
        assert geometry[key] is None, key
    assert geometry["chamfer_m"] > 0


def test_amid_surroundings_the_target_is_judged_alone_too(
    run, few_samples, no_projections, monkeypatch
):
    sphere = trimesh.creation.icosphere(subdivisions=3, radius=0.02)
    slab = trimesh.creation.box((0.1, 0.1, 0.01))
    slab.apply_translation((0, 0, -0.09))
    both = trimesh.util.concatenate([slab, sphere])
    scene = Scene(both, background=np.arange(len(both.faces)) < len(slab.faces))
    monkeypatch.setattr(reconstruct_module, "load_scene", lambda *given: scene)
    geometry = evaluate(run)["geometry"]
    assert geometry.keys() == GEOMETRY | {"target"}
    assert geometry["target"]["share"] == 1.0  # nothing was reconstructed near the slab
    assert geometry["target"]["fscore"]["0.005"] > geometry["fscore"]["0.005"]
    assert geometry["target"]["chamfer_m"] < geometry["chamfer_m"]


@pytest.mark.parametrize("content", [b"", b"ply\nnonsense", b"\x00" * 100])
def test_a_damaged_mesh_is_told(run, content, no_projections):
    reconstruct(run, spacing=0.012)
    (run / "reconstruction" / "mesh.ply").write_bytes(content)
    with pytest.raises(InputError, match=r"mesh\.ply: .*reconstruct again"):
        evaluate(run)


def test_the_hull_of_first_echoes_is_the_surface_where_the_field_has_none(
    run, no_projections, monkeypatch
):
    real, asked = reconstruct_module.read_out, []

    def only_the_hull(field, *, method, **options):
        asked.append(method)
        if method != "hull":
            raise NumericalError("no surface: the lattice is empty")
        return real(field, method=method, **options)

    monkeypatch.setattr(reconstruct_module, "read_out", only_the_hull)
    folder = reconstruct(run)
    assert asked == ["filled", "hull"]
    assert read_out(folder)["method"] == "hull"
    with pytest.raises(NumericalError, match="the lattice is empty"):
        reconstruct(run, method="open")
