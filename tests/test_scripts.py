# SPDX-License-Identifier: MIT
"""A script goes from a scene to a surface without the command line, and a run is opened."""

from __future__ import annotations

from functools import partial

import lightning
import numpy as np
import pytest
import trimesh

import sononerf as sn
from sononerf.errors import InputError, SettingsError
from sononerf.field.fitting import quiet_lightning
from sononerf.progress import Progress
from sononerf.refinement import reconstruction
from sononerf.refinement.refine import Refinement
from tests.run.test_refine import SHORT

QUIET = Progress(quiet=True)
SMALL = {"finest": 0.01, "levels": 2}


@pytest.fixture(scope="module")
def made(tmp_path_factory):
    """What the script of docs/python.md makes, on a small ball."""
    quiet_lightning()
    folder = tmp_path_factory.mktemp("script")
    trimesh.creation.icosphere(subdivisions=3, radius=20.0).export(folder / "ball.stl")
    scene = sn.Scene.load(folder / "ball.stl", unit="mm")
    head = sn.Head(spectrogram={"range_min": 0.34, "range_max": 0.45})
    echoes = sn.simulate(
        scene, sn.Poses.sphere(24, radius=0.4), head, options={"rays": 500, "sources": 60},
        workers=1, progress=QUIET,
    )  # fmt: skip
    model = sn.EchoModule.for_echoes(
        echoes, field="grid", renderer="profile", field_options=SMALL,
        renderer_options={"start": 2000}, options={"steps_per_epoch": 10},
    )  # fmt: skip
    trainer = lightning.Trainer(
        max_epochs=2, logger=False, enable_checkpointing=False, enable_progress_bar=False,
        enable_model_summary=False, default_root_dir=folder,
    )  # fmt: skip
    trainer.fit(model, sn.EchoDataModule(echoes))
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(reconstruction, "RAYS", 500)
        patch.setattr(reconstruction, "Refinement", partial(Refinement, stages=SHORT))
        start = sn.reconstruct(model, echoes, options={"spacing": 0.008}, progress=QUIET)
        surface = sn.refine(start, echoes, progress=QUIET)
    return scene, echoes, model, surface


def test_from_a_scene_to_numbers(made, tmp_path):
    scene, echoes, model, surface = made
    heard = sn.predict(model, None, echoes.poses("test"), progress=QUIET)
    numbers = sn.compare(heard, echoes)
    assert numbers["mae_db"] == numbers["rendered_mae_db"] > 0
    assert numbers["traced_weight"] == 0
    geometry = sn.evaluate(surface, scene, progress=QUIET)
    assert geometry["chamfer_m"] < 0.01
    assert "chamfer_m" in str(geometry)
    assert "mm" in str(geometry)
    surface.save(tmp_path / "mesh.ply")
    assert len(trimesh.load_mesh(tmp_path / "mesh.ply").faces) == len(surface.mesh.faces)


def test_echoes_alone_give_a_surface(made):
    _, echoes, model, _ = made
    surface = sn.reconstruct(echoes, progress=QUIET)
    assert surface.method == "levels"
    assert surface.mesh.is_watertight
    off = np.abs(np.linalg.norm(surface.mesh.vertices, axis=1) - 0.02)
    assert np.median(off) < echoes.head.resolution / 2
    assert len(surface.confidence) == len(surface.mesh.vertices)
    assert surface.confidence.max() > 0
    with pytest.raises(SettingsError, match="method isosurface needs a fitted model"):
        sn.reconstruct(echoes, options={"method": "isosurface"})
    with pytest.raises(InputError, match="give the echoes that the model was fitted to"):
        sn.reconstruct(model)


def test_a_mesh_of_ones_own_is_a_surface(made):
    scene, echoes, model, _ = made
    mine = sn.Surface(scene.mesh)
    assert mine.method == "given"
    with pytest.raises(InputError, match="does not know the echoes"):
        sn.predict(model, mine, echoes.poses("test"), progress=QUIET)
    with pytest.raises(InputError, match="mesh is a list"):
        sn.Surface([1, 2, 3])
    with pytest.raises(InputError, match="no triangles"):
        sn.Surface(trimesh.Trimesh())
    with pytest.raises(InputError, match=r"mesh\.obj: expected a name that ends in \.ply"):
        mine.save("mesh.obj")
    iso = sn.reconstruct(
        model, echoes, options={"method": "isosurface", "spacing": 0.008}, progress=QUIET
    )
    with pytest.raises(SettingsError, match="an iso-surface is not refined"):
        sn.refine(iso, echoes, progress=QUIET)


def test_what_does_not_go_together_is_named(made):
    scene, echoes, model, surface = made
    with pytest.raises(InputError, match="found Surface and Echoes, expected a Prediction and"):
        sn.compare(surface, echoes)
    with pytest.raises(InputError, match="found a Echoes, expected a Surface"):
        sn.evaluate(echoes, scene, progress=QUIET)
    far = sn.Poses.sphere(2, radius=3.0)
    with pytest.raises(InputError, match=r"from pose 0 .* the fitted region lies"):
        sn.predict(model, None, far, progress=QUIET)


@pytest.mark.parametrize(
    ("call", "message"),
    [
        (lambda scene, echoes: sn.simulate(scene.mesh, echoes.poses()), "scene is a Trimesh"),
        (lambda scene, echoes: sn.simulate(scene, [1, 2]), "poses is a list"),
        (lambda scene, echoes: sn.simulate(scene, echoes.poses(), {}), "head is a dict"),
        (lambda scene, echoes: sn.Echoes.from_arrays([], [1], echoes.head), "poses is a list"),
        (lambda scene, echoes: sn.EchoModule.for_echoes(scene), "echoes is a Scene"),
        (lambda scene, echoes: sn.EchoDataModule(scene), "echoes is a Scene"),
        (lambda scene, echoes: sn.reconstruct(scene, echoes), "model is a Scene"),
        (lambda scene, echoes: sn.refine(scene.mesh, echoes), "surface is a Trimesh"),
        (lambda scene, echoes: sn.predict(3, None, echoes.poses()), "model is a int"),
        (lambda scene, echoes: sn.Poses.sphere(0, radius=0.4), "count is 0"),
        (lambda scene, echoes: sn.Poses.sphere(3, radius=0.0), "radius 0.0 m"),
    ],
)
def test_an_argument_of_another_kind_is_named(made, call, message):
    scene, echoes, _, _ = made
    with pytest.raises(InputError, match=f"^.*{message}.*expected"):
        call(scene, echoes)


@pytest.mark.slow
def test_objects_show_themselves_in_a_notebook(made):
    scene, echoes, model, surface = made
    heard = sn.predict(model, None, echoes.poses("test"), progress=QUIET)
    pictured = (scene, echoes, surface, heard)
    for shown in (*pictured, echoes.poses(), echoes.head, sn.compare(heard, echoes)):
        text = shown._repr_html_()
        assert type(shown).__name__ in text
        assert ("data:image/png" in text) == any(shown is each for each in pictured)
    number = int(echoes.numbers_of(echoes.poses("test"))[0])
    alone, both = echoes.plot(number), echoes.plot(number, heard)
    assert alone._repr_png_()[:4] == b"\x89PNG"
    assert len(both.data) > len(alone.data)
