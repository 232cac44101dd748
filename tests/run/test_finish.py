# SPDX-License-Identifier: MIT
"""The stages after a fit come in their order, each once, and an interrupted call goes on."""

from __future__ import annotations

import functools
import shutil
import threading

import pytest
import safetensors.torch
import trimesh

from sononerf import storage
from sononerf.errors import LockedError, NumericalError, ResourceError
from sononerf.evaluation import baseline
from sononerf.evaluation import geometry as geometry_module
from sononerf.field.checkpoint_io import load_weights, save_weights
from sononerf.progress import Progress
from sononerf.run import fit as finish_module
from sononerf.run import run as run_module
from sononerf.run.evaluate import evaluate
from sononerf.run.fit import finish
from sononerf.run.model_files import NAME
from sononerf.run.predict import predict
from sononerf.run.reconstruct import reconstruct
from sononerf.run.run import STAGES, Run

SPHERE = trimesh.creation.icosphere(subdivisions=3, radius=0.02)


class Heard(Progress):
    """Keeps what is said."""

    def __init__(self):
        super().__init__(quiet=True)
        self.said = []

    def say(self, text):
        self.said.append(text)


@pytest.fixture
def run(fitted_run, tmp_path):
    path = tmp_path / "run"
    path.mkdir()
    for name in ("model.safetensors", "model.json"):
        shutil.copy(fitted_run / name, path)
    return path


@pytest.fixture
def steps(monkeypatch):
    """Let every stage say its name and leave what tells that it is done."""
    called = []

    def reconstruct_quickly(run, **options):
        called.append("surface")
        run.reconstruction.mkdir(exist_ok=True)
        (run.reconstruction / "mesh.ply").write_bytes(SPHERE.export(file_type="ply"))
        storage.commit_json(run.reconstruction / "read_out.json", {"level": None})

    def learn_quickly(fitted, echoes, mesh, simulation, **options):
        called.append("traced")
        return finish_module.Traced.none(mesh, fitted.head)

    def predict_quickly(run, **options):
        called.append("prediction")
        run.write_metrics("prediction", {})

    def evaluate_quickly(run, **options):
        called.append("evaluation")
        run.write_metrics("geometry", None)
        run.write_metrics("baseline", {})

    for name, made in (
        ("reconstruct", reconstruct_quickly),
        ("learn_traced", learn_quickly),
        ("predict", predict_quickly),
        ("evaluate", evaluate_quickly),
    ):
        monkeypatch.setattr(finish_module, name, made)
    return called


ALL = list(STAGES[1:])
STEPS = {
    "surface": "reconstruct",
    "traced": "learn_traced",
    "prediction": "predict",
    "evaluation": "evaluate",
}


def test_each_stage_is_done_once_and_in_its_order(run, steps):
    assert not Run(run).is_finished
    finish(run, accelerator="cpu")
    assert steps == ALL
    assert Run(run).is_finished
    finish(run, accelerator="cpu")
    assert steps == ALL


@pytest.mark.parametrize("stage", ALL)
def test_an_interrupt_repeats_its_own_stage_alone(run, steps, stage):
    with pytest.MonkeyPatch.context() as patch:

        def interrupted(*given, **options):
            raise KeyboardInterrupt

        patch.setattr(finish_module, STEPS[stage], interrupted)
        with pytest.raises(KeyboardInterrupt):
            finish(run, accelerator="cpu")
    assert steps == ALL[: ALL.index(stage)]
    finish(run, accelerator="cpu")
    assert steps == ALL


def test_another_surface_repeats_what_depends_on_it(run, steps):
    finish(run, accelerator="cpu")
    opened = Run(run)
    opened.begin("surface")
    assert [stage for stage in STAGES if opened.is_done(stage)] == ["fit", "traced", "prediction"]
    bumpy = SPHERE.copy().apply_scale(1.01)
    with opened.locked():
        mesh = bumpy.export(file_type="ply")
        storage.commit_bytes(opened.reconstruction / "mesh.ply", mesh)
        storage.commit_json(opened.reconstruction / "read_out.json", {"level": None})
    del steps[:]
    finish(run, accelerator="cpu")
    assert steps == ["traced", "prediction", "evaluation"]


def test_traces_of_another_fit_do_not_count(run, steps):
    finish(run, accelerator="cpu")
    tensors = safetensors.torch.load_file(run / NAME)
    (run / NAME).write_bytes(safetensors.torch.save(tensors, {"model": "of another fit"}))
    assert not Run(run).is_finished


def test_nothing_is_predicted_where_nothing_is_held_out(run, steps):
    state, description = load_weights(run)
    description["settings"]["poses"]["heldout"] = 0
    save_weights(run, state, description)
    finish(run)
    assert steps == ["surface", "traced", "evaluation"]
    assert Run(run).is_finished


@pytest.mark.parametrize("stage", ["surface", "traced"])
def test_a_field_without_a_surface_predicts_before_it_is_told(run, steps, monkeypatch, stage):
    def silent(*given, **options):
        raise NumericalError("the field is silent everywhere")

    monkeypatch.setattr(finish_module, STEPS[stage], silent)
    with pytest.raises(NumericalError, match="silent everywhere"):
        finish(run)
    assert steps[-1] == "prediction"


def test_a_surface_that_cannot_be_traced_is_told_and_no_fault(run, steps, monkeypatch, caplog):
    monkeypatch.undo()
    opened = Run(run)
    opened.reconstruction.mkdir()
    speck = trimesh.creation.icosphere(radius=1e-5)
    (opened.reconstruction / "mesh.ply").write_bytes(speck.export(file_type="ply"))
    finish_module._learn_traced(opened, "cpu", Progress(quiet=True))
    assert "no echoes are traced off the surface: " in caplog.text
    assert not opened.traced().weight.any()


def test_too_little_memory_to_trace_is_told_and_tried_again(run, steps, monkeypatch):
    def lack(*given, **options):
        raise ResourceError("too little memory")

    with monkeypatch.context() as patch:
        patch.setattr(finish_module, "learn_traced", lack)
        progress = Heard()
        finish(run, progress=progress)
    assert any("tries again: too little memory" in text for text in progress.said)
    assert not Run(run).is_finished
    steps.clear()
    finish(run)
    assert steps[0] == "traced"
    assert Run(run).is_finished


def test_one_call_loads_field_and_echoes_once(run, no_projections, monkeypatch):
    metrics = functools.partial(geometry_module.geometry_metrics, samples=2000)
    monkeypatch.setattr(geometry_module, "geometry_metrics", metrics)
    monkeypatch.setattr(geometry_module, "BASELINE_VOXELS", 16)
    monkeypatch.setattr(baseline, "LEVEL_SAMPLES", 300)
    loaded = []
    for home, name in ((run_module.model_files, "read_model"), (run_module, "find_ensemble")):
        real = getattr(home, name)
        monkeypatch.setattr(
            home, name, lambda *given, real=real, n=name: loaded.append(n) or real(*given)
        )
    monkeypatch.setattr(
        finish_module, "learn_traced", lambda f, e, m, s, **o: finish_module.Traced.none(m, f.head)
    )
    finish(run, accelerator="cpu")
    assert sorted(loaded) == ["find_ensemble", "read_model"]


@pytest.mark.parametrize("command", [reconstruct, predict, evaluate, finish])
def test_a_run_in_use_is_left_alone(run, command):
    before = sorted(run.rglob("*"))
    caught = []

    def elsewhere():
        with pytest.raises(LockedError) as error:
            command(run)
        caught.append(error.value)

    with storage.lock(run):
        other = threading.Thread(target=elsewhere)
        other.start()
        other.join()
    assert "in use by another process" in str(caught[0])
    assert {path for path in run.rglob("*") if path.name != ".lock"} == set(before)


def test_the_lock_is_held_until_the_last_number_is_written(run, steps, monkeypatch):
    written = []
    real = Run.write_metrics

    def watched(self, *given, **options):
        written.append((self.path / ".lock").is_file())
        return real(self, *given, **options)

    monkeypatch.setattr(Run, "write_metrics", watched)
    finish(run, accelerator="cpu")
    assert written
    assert all(written)
