# SPDX-License-Identifier: MIT
"""A run's surface is refined against its echoes, and an interrupted refinement goes on."""

from __future__ import annotations

import json
import shutil
from functools import partial

import pytest
import trimesh
from tensorboard.backend.event_processing.event_accumulator import EventAccumulator

from sononerf.progress import Progress
from sononerf.refinement import descent as stages
from sononerf.refinement import objective as core
from sononerf.refinement import reconstruction
from sononerf.refinement.descent import Stage
from sononerf.refinement.refine import Refinement
from sononerf.run import reconstruct as reconstruct_module
from sononerf.run.reconstruct import reconstruct, refine_surface
from sononerf.run.run import Run
from sononerf.start.surface import Surface
from sononerf.storage import commit_json, read_json

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
    monkeypatch.setattr(stages, "STAGES", SHORT)
    monkeypatch.setattr(reconstruction, "Refinement", partial(Refinement, stages=SHORT))
    for name in ("mesh_png", "side_by_side_png", "confidence_png"):
        monkeypatch.setattr(reconstruct_module, name, lambda *given: b"")
    path = tmp_path / "run"
    shutil.copytree(fitted_run, path)
    return path


def with_settings(run, section, **values):
    description = json.loads((run / "model.json").read_text())
    description["settings"][section] |= values
    commit_json(run / "model.json", description)


def refined(path, start=BUMPY):
    return refine_surface(Run(path), Surface(start), accelerator="cpu", progress=QUIET)


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
    # The first stage of each way, and further ones of the best.
    assert stages_shown == list(range(1, len(stages_shown) + 1))
    assert 4 <= len(stages_shown) <= 8
    assert "mesh/refinement_stages_VERTEX" in events.Tags()["tensors"]
    again = reconstruct(run, refine=False, spacing=0.008, accelerator="cpu")
    found = read_json(again / "read_out.json")
    assert found["validation_error_db"] is found["median_error_m"] is None


def test_without_its_echoes_a_run_has_an_isosurface(run, no_projections):
    with_settings(run, "reconstruction", refine=True)
    with_settings(run, "data", store=str(run.parent / "gone"))
    heard = Heard()
    folder = reconstruct(run, accelerator="cpu", spacing=0.008, progress=heard)
    assert heard.said[0].startswith(
        "an iso-surface is taken, because the surface needs the echoes: "
    )
    assert "is not there" in heard.said[0]
    assert read_json(folder / "read_out.json")["method"] == "isosurface"
