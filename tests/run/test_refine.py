# SPDX-License-Identifier: MIT
"""A run's surface is refined against its echoes, and an interrupted refinement goes on."""

from __future__ import annotations

import json
import shutil

import numpy as np
import pytest
import safetensors.torch
import torch
import trimesh
from tensorboard.backend.event_processing.event_accumulator import EventAccumulator

from sononerf.checksums import recorded
from sononerf.errors import IncompatibleError, ResourceError
from sononerf.progress import Progress
from sononerf.run import reconstruct as reconstruct_module
from sononerf.run.reconstruct import STATE, reconstruct, refine_surface
from sononerf.run.run_folder import RunFolder
from sononerf.storage import commit_json, read_json
from sononerf.surface import reconstruction
from sononerf.surface.refine import comparison as core
from sononerf.surface.refine import descent as stages
from sononerf.surface.refine import refinement as refinement_module
from sononerf.surface.refine.descent import Stage
from sononerf.surface.refine.refinement import Refinement
from sononerf.surface.surface import Surface

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
    for where, name in ((core, "RAYS"), (reconstruction, "RAYS")):
        monkeypatch.setattr(where, name, 500)
    for where in (refinement_module, stages):
        monkeypatch.setattr(where, "STAGES", SHORT)
    for name in ("mesh_png", "side_by_side_png", "confidence_png"):
        monkeypatch.setattr(reconstruct_module, name, lambda *given: b"")
    path = tmp_path / "run"
    shutil.copytree(fitted_run, path)
    return path


def with_settings(run, section, **values):
    description = json.loads((run / "model.json").read_text())
    description["settings"][section] |= values
    with recorded(run):
        commit_json(run / "model.json", description)


def refined(path, start=BUMPY):
    return refine_surface(RunFolder(path), Surface(start), accelerator="cpu", progress=QUIET)


def test_a_run_has_its_refined_surface(run, no_projections):
    with_settings(run, "reconstruction", refine=True)
    folder = reconstruct(run, accelerator="cpu", spacing=0.008)
    found = read_json(folder / "read_out.json")
    assert isinstance(found["refined"], bool)
    assert found["validation_error_db"] > 0
    assert 0 < found["median_error_from_twice_m"] < found["median_error_m"]
    events = EventAccumulator(str(run / "tensorboard" / run.name))
    events.Reload()
    # Event files of one second are read by their names, in which file 10 comes before file 9.
    stages_shown = sorted(one.step for one in events.Scalars("refinement/validation_error_dB"))
    # Both ways of levels and of another start, and the second stage of one of them or of both.
    assert stages_shown in ([1, 2, 3, 4, 5], [1, 2, 3, 4, 5, 6])
    assert "mesh/refinement_stages_VERTEX" in events.Tags()["tensors"]
    again = reconstruct(run, method="filled", spacing=0.008, accelerator="cpu")
    found = read_json(again / "read_out.json")
    assert found["validation_error_db"] is found["median_error_m"] is None


def test_without_its_echoes_a_surface_is_not_refined(run, no_projections):
    with_settings(run, "reconstruction", refine=True)
    with_settings(run, "data", store=str(run.parent / "gone"))
    heard = Heard()
    folder = reconstruct(run, accelerator="cpu", spacing=0.008, progress=heard)
    assert heard.said[0].startswith("the surface is not refined: ")
    assert "is not there" in heard.said[0]
    assert read_json(folder / "read_out.json")["method"] == "filled"


@pytest.fixture
def interrupted(run, monkeypatch):
    """A run whose refinement was interrupted after four steps."""
    with_settings(run, "fit", checkpoint_seconds=1e-9)
    real, steps = Refinement.advance, []

    def stops(self):
        if len(steps) == 4:
            raise KeyboardInterrupt
        steps.append(self.drawn)
        return real(self)

    with monkeypatch.context() as patch:
        patch.setattr(Refinement, "advance", stops)
        with pytest.raises(KeyboardInterrupt):
            refined(run)
    assert (run / STATE).is_file()
    return run


def test_an_interrupted_refinement_goes_on_to_the_same_surface(interrupted, monkeypatch):
    real, more = Refinement.advance, []
    monkeypatch.setattr(Refinement, "advance", lambda self: more.append(self.drawn) or real(self))
    again = refined(interrupted)
    assert more == [4, 5, 6, 7, 8]  # the first stage is done twice
    assert not (interrupted / STATE).exists()
    whole = refined(interrupted)
    np.testing.assert_array_equal(again.mesh.vertices, whole.mesh.vertices)


@pytest.mark.slow
@pytest.mark.parametrize("what", ["another start", "damaged"])
def test_a_state_that_does_not_fit_is_ignored(interrupted, what):
    if what == "damaged":
        (interrupted / STATE).write_bytes(b"nonsense")
        wanted = BUMPY
    else:
        wanted = BUMPY.copy().apply_scale(1.1)
    found = refined(interrupted, wanted)
    (interrupted / STATE).unlink(missing_ok=True)
    np.testing.assert_array_equal(found.mesh.vertices, refined(interrupted, wanted).mesh.vertices)


def as_other_version(file):
    file.write_bytes(safetensors.torch.save(safetensors.torch.load_file(file), {"of": "a start"}))


def as_other_stages(file):
    with safetensors.safe_open(str(file), "pt") as opened:
        said = {**opened.metadata(), "stages": "()"}
    file.write_bytes(safetensors.torch.save(safetensors.torch.load_file(file), said))


@pytest.mark.slow
@pytest.mark.parametrize("change", [as_other_version, as_other_stages])
def test_a_state_of_another_version_is_refused_before_anything_is_written(
    interrupted, change, no_projections
):
    with_settings(interrupted, "reconstruction", refine=True)
    change(interrupted / STATE)
    before = {p: p.read_bytes() for p in interrupted.rglob("*") if p.is_file()}
    with pytest.raises(IncompatibleError, match=r"surface\.safetensors: .* remove this file"):
        reconstruct(interrupted, accelerator="cpu", spacing=0.008)
    assert {p: p.read_bytes() for p in interrupted.rglob("*") if p.is_file()} == before
    (interrupted / STATE).unlink()
    assert reconstruct(interrupted, accelerator="cpu", spacing=0.008).is_dir()


def test_a_gpu_that_is_not_there_is_refused(run, monkeypatch):
    monkeypatch.setattr(torch.cuda, "is_available", lambda: False)
    with pytest.raises(ResourceError, match="no GPU"):
        refine_surface(RunFolder(run), Surface(BUMPY), accelerator="gpu", progress=QUIET)
