# SPDX-License-Identifier: MIT
"""A fitted field becomes files, and numbers where the truth is known."""

from __future__ import annotations

import io
import json

import numpy as np
import pytest
import trimesh
from PIL import Image

from sononerf.errors import NumericalError
from sononerf.progress import Progress
from sononerf.run import reconstruct as reconstruct_module
from sononerf.run.fitted import load_fitted
from sononerf.run.reconstruct import reconstruct
from sononerf.surface.openness import Openness
from sononerf.surface.start import read_out as read_out_module
from sononerf.surface.start.read_out import Reconstruction
from sononerf.surface.start.volume import Volume


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
        assert resolution == load_fitted(run).head.resolution
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
