# SPDX-License-Identifier: MIT
"""A run's surface is refined against its echoes, and an interrupted refinement goes on."""

from __future__ import annotations

import shutil
from dataclasses import replace

import numpy as np
import pytest
import torch
import trimesh

from sononerf.errors import ResourceError
from sononerf.progress import Progress
from sononerf.run import reconstruct as reconstruct_module
from sononerf.run import refine as module
from sononerf.run.fitted import load_fitted
from sononerf.run.reconstruct import reconstruct
from sononerf.run.refine import STATE, refine_surface
from sononerf.storage import read_json
from sononerf.surface.refine import comparison as core
from sononerf.surface.refine.refinement import Refinement
from sononerf.surface.refine.stages import Stage

QUIET = Progress(quiet=True)
BUMPY = trimesh.creation.icosphere(subdivisions=3, radius=0.0205)
SHORT = (
    Stage(smoothing=2.4, edge=0.8, blur=0.0, rate=0.02, steps=3, beyond="none"),
    Stage(smoothing=1.5, edge=0.8, blur=0.0, rate=0.02, steps=3, beyond="simulate"),
)

pytestmark = pytest.mark.usefixtures("without_pictures")


class Heard(Progress):
    """Keeps what is said."""

    def __init__(self):
        super().__init__(quiet=True)
        self.said = []

    def say(self, text):
        self.said.append(text)


@pytest.fixture
def run(fitted_run, tmp_path, monkeypatch):
    for where, name in ((core, "RAYS"), (module, "RAYS")):
        monkeypatch.setattr(where, name, 500)
    real = Refinement.__init__

    def short(self, *given, **named):
        real(self, *given, **{**named, "stages": SHORT})

    monkeypatch.setattr(Refinement, "__init__", short)
    path = tmp_path / "run"
    shutil.copytree(fitted_run, path)
    return path


def refined(path, start=BUMPY, progress=QUIET):
    return refine_surface(
        path, load_fitted(path), {"filled": start}, accelerator="cpu", progress=progress
    )


def test_a_run_has_its_refined_surface(run, monkeypatch):
    monkeypatch.setattr(reconstruct_module, "mesh_png", lambda *given: b"")
    monkeypatch.setattr(reconstruct_module, "side_by_side_png", lambda *given: b"")
    fitted = load_fitted(run)
    options = fitted.settings.reconstruction.model_copy(update={"refine": True})
    wanted = fitted.settings.model_copy(update={"reconstruction": options})
    asked = []

    def noted(path, fitted, starts, *, accelerator, progress):
        asked.append(accelerator)
        return refine_surface(
            path, fitted, {"filled": BUMPY}, accelerator=accelerator, progress=progress
        )

    monkeypatch.setattr(reconstruct_module, "refine_surface", noted)
    monkeypatch.setattr(
        reconstruct_module,
        "load_fitted",
        lambda path: replace(fitted, settings=wanted),
    )
    folder = reconstruct(run, accelerator="cpu", spacing=0.008)
    assert asked == ["cpu"]
    found = read_json(folder / "read_out.json")
    assert isinstance(found["refined"], bool)
    assert found["validation_error_db"] > 0
    reconstruct(run, level=0.3, spacing=0.008, accelerator="cpu")
    assert asked == ["cpu"]  # a level of the user's is not refined away


def test_without_its_echoes_a_surface_is_not_refined(run, monkeypatch):
    description = (run / "model.json").read_text()
    store = load_fitted(run).settings.data.store
    (run / "model.json").write_text(description.replace(str(store), str(store) + "-gone"))
    heard = Heard()
    fitted = load_fitted(run)
    assert reconstruct_module._refined(run, fitted, {"filled": BUMPY}, "cpu", heard) is None
    (line,) = heard.said
    assert line.startswith("the surface is not refined: ")
    assert "is not there" in line


def test_an_interrupted_refinement_goes_on_to_the_same_surface(run, monkeypatch):
    whole = refined(run)
    assert not (run / STATE).exists()
    fitted = load_fitted(run)
    often = fitted.settings.fit.model_copy(update={"checkpoint_seconds": 1e-9})
    hasty = replace(fitted, settings=fitted.settings.model_copy(update={"fit": often}))
    real, steps = Refinement.advance, []

    def stops(self):
        if len(steps) == 4:
            raise KeyboardInterrupt
        steps.append(self.drawn)
        return real(self)

    monkeypatch.setattr(Refinement, "advance", stops)
    with pytest.raises(KeyboardInterrupt):
        refine_surface(run, hasty, {"filled": BUMPY}, accelerator="cpu", progress=QUIET)
    assert (run / STATE).is_file()
    more = []
    monkeypatch.setattr(Refinement, "advance", lambda self: more.append(self.drawn) or real(self))
    again = refine_surface(run, hasty, {"filled": BUMPY}, accelerator="cpu", progress=QUIET)
    assert more == [4, 5, 6, 7, 8]  # the first stage is done twice
    np.testing.assert_array_equal(again.mesh.vertices, whole.mesh.vertices)
    assert not (run / STATE).exists()


@pytest.mark.parametrize("what", ["another start", "damaged"])
def test_a_state_that_does_not_fit_is_ignored(run, what):
    (run / STATE).parent.mkdir(exist_ok=True)
    if what == "damaged":
        (run / STATE).write_bytes(b"nonsense")
    else:
        fitted = load_fitted(run)
        work = module.Refinement(
            {"filled": BUMPY.copy().apply_scale(1.1)},
            module.Echoes.of(module.store_of(fitted)),
            module.Optics(fitted.head),
            simulate=lambda mesh: None,
            seed=0,
        )
        work.advance()
        module._save(run / STATE, work, "of another start")
    assert refined(run).mesh is not None


def test_a_gpu_that_is_not_there_is_refused(run, monkeypatch):
    monkeypatch.setattr(torch.cuda, "is_available", lambda: False)
    with pytest.raises(ResourceError, match="no GPU"):
        refine_surface(run, load_fitted(run), {"filled": BUMPY}, accelerator="gpu", progress=QUIET)
