# SPDX-License-Identifier: MIT
"""What follows a fit comes in its order, and a field without a surface predicts all the same."""

from __future__ import annotations

import shutil

import pytest
import trimesh

from sononerf.errors import NumericalError
from sononerf.field.weights import load_weights, save_weights
from sononerf.progress import Progress
from sononerf.run import finish as finish_module
from sononerf.run.finish import finish, is_finished
from sononerf.run.run_folder import RunFolder
from sononerf.run.traced import NAME, learn_traced


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
    """Let every step say its name and nothing more."""
    called = []
    for name in ("learn_traced", "predict"):
        monkeypatch.setattr(
            finish_module,
            name,
            lambda path, *, accelerator, progress, name=name: called.append((name, accelerator)),
        )
    for name in ("reconstruct", "evaluate"):
        monkeypatch.setattr(
            finish_module,
            name,
            lambda path, *, progress, name=name, **given: called.append(name) or given,
        )
    return called


def test_traces_are_learned_off_the_mesh_before_anything_is_predicted(run, steps):
    finish(run, accelerator="cpu")
    assert steps == ["reconstruct", ("learn_traced", "cpu"), ("predict", "cpu"), "evaluate"]


def test_nothing_is_predicted_where_nothing_is_held_out(run, steps):
    state, description = load_weights(run)
    description["settings"]["poses"]["heldout"] = 0
    save_weights(run, state, description)
    finish(run)
    assert steps == ["reconstruct", ("learn_traced", "auto"), "evaluate"]


@pytest.mark.parametrize("name", ["reconstruct", "learn_traced"])
def test_a_field_without_a_surface_predicts_before_it_is_told(run, steps, monkeypatch, name):
    def silent(path, **options):
        raise NumericalError("the field is silent everywhere")

    monkeypatch.setattr(finish_module, name, silent)
    with pytest.raises(NumericalError, match="silent everywhere"):
        finish(run)
    assert steps[-1] == ("predict", "auto")


def test_a_surface_that_cannot_be_traced_is_told_and_no_fault(run, steps, monkeypatch):
    def speck(path, **given):
        mesh = trimesh.creation.icosphere(radius=1e-5)
        (path / "reconstruction").mkdir()
        (path / "reconstruction" / "mesh.ply").write_bytes(mesh.export(file_type="ply"))

    monkeypatch.setattr(finish_module, "reconstruct", speck)
    monkeypatch.setattr(finish_module, "learn_traced", learn_traced)
    progress = Heard()
    finish(run, accelerator="cpu", progress=progress)
    assert any(text.startswith("no echoes are traced off the surface: ") for text in progress.said)
    assert steps == [("predict", "cpu"), "evaluate"]


def test_a_run_is_finished_when_its_mesh_and_all_that_comes_of_it_are_there(run):
    assert not is_finished(run)
    numbers = RunFolder(run)
    mesh = run / "reconstruction" / "mesh.ply"
    mesh.parent.mkdir()
    mesh.touch()
    numbers.write_metrics("geometry", None)  # of a scene that is not installed here
    numbers.write_metrics("baseline", {})
    assert not is_finished(run)  # as a run of before echoes were traced
    (run / NAME).touch()
    assert is_finished(run)
    mesh.unlink()
    assert not is_finished(run)
    mesh.touch()
    for section in ("geometry", "baseline"):
        numbers.drop_metrics(section)
        assert not is_finished(run)
        numbers.write_metrics(section, {})
        assert is_finished(run)
    (run / "metrics.json").unlink()
    assert not is_finished(run)
