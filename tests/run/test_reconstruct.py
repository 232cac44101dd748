# SPDX-License-Identifier: MIT
"""A fitted field becomes files, and numbers where the truth is known."""

from __future__ import annotations

import io
import json

import numpy as np
import pytest
import trimesh
from PIL import Image

from sononerf.errors import NumericalError, SettingsError
from sononerf.run.reconstruct import reconstruct
from sononerf.scene.gltf import Z_UP


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
    meshes["glb"].vertices = meshes["glb"].vertices @ Z_UP.T  # y is up there
    for mesh in meshes.values():
        np.testing.assert_allclose(mesh.bounds, meshes["ply"].bounds, atol=1e-6)
    volume = pyvista.read(folder / "volume.vti")
    assert np.isfinite(volume.point_data.active_scalars).all()
    assert volume.spacing[0] == pytest.approx(read_out(folder)["spacing_m"])
    for picture in folder.glob("*.png"):
        with Image.open(io.BytesIO(picture.read_bytes())) as image:
            assert min(image.size) > 50
    assert json.loads((run / "metrics.json").read_text())["cost"]["reconstruct_s"] > 0


@pytest.mark.slow
def test_spacing_and_level_are_obeyed(run, tmp_path, no_projections):
    coarse = reconstruct(run, spacing=0.012, output=tmp_path / "coarse")
    assert read_out(coarse)["method"] == "levels"
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


ISO = {"method": "isosurface", "level": "known"}


@pytest.mark.parametrize(
    ("settings", "given", "expected"),
    [
        ({}, {}, "levels"),
        ({}, {"level": "known"}, "isosurface"),
        (ISO, {}, "isosurface"),
        (ISO, {"method": "levels"}, "levels"),
    ],
)
def test_what_the_caller_gives_replaces_the_settings(
    run, tmp_path, no_projections, settings, given, expected
):
    plain = reconstruct(run, spacing=0.012, method="isosurface", output=tmp_path / "plain")
    level = read_out(plain)["level"]
    settings, given = (
        {key: level if value == "known" else value for key, value in part.items()}
        for part in (settings, given)
    )
    description = json.loads((run / "model.json").read_text())
    description["settings"]["reconstruction"] |= settings
    (run / "model.json").write_text(json.dumps(description))
    found = read_out(reconstruct(run, spacing=0.012, output=tmp_path / "out", **given))
    assert found["method"] == expected
    assert found["level"] == (level if expected == "isosurface" else None)


def test_a_true_surface_that_is_gone_costs_nothing_but_its_view(
    run, tmp_path, no_projections, caplog
):
    description = json.loads((run / "model.json").read_text())
    description["settings"]["evaluation"]["truth"] = "gone.ply"
    (run / "model.json").write_text(json.dumps(description))
    folder = reconstruct(run, spacing=0.012, output=tmp_path / "out")
    assert (folder / "view.png").is_file()
    assert caplog.messages[0] == (
        "the view shows no true surface: evaluation.truth: gone.ply: cannot be read "
        "(No such file or directory)"
    )


def test_only_an_isosurface_has_a_level(run):
    with pytest.raises(SettingsError, match="method levels has no level"):
        reconstruct(run, method="levels", level=0.5)


def test_a_level_above_everything_has_no_surface(run):
    with pytest.raises(NumericalError):
        reconstruct(run, level=1e9)
