# SPDX-License-Identifier: MIT
"""The weight of echoes traced off the surface comes from validation poses alone."""

from __future__ import annotations

import hashlib
import json
import shutil

import numpy as np
import pytest
import safetensors.torch
import torch
import trimesh

from sononerf.echoes.store import EnsembleStore
from sononerf.errors import InputError
from sononerf.evaluation import traced as traced_module
from sononerf.evaluation.traced import Traced, mix
from sononerf.field.checkpoint_io import load_weights, save_weights
from sononerf.field.fitting import render_poses
from sononerf.head.front_end import compress
from sononerf.progress import Progress
from sononerf.run import fit as finish_module
from sononerf.run import predict as predict_module
from sononerf.run.build import NAME, load_traced
from sononerf.run.predict import predict
from sononerf.run.run import Run

QUIET = Progress(quiet=True)
ROWS = 47  # frequencies
SPHERE = trimesh.creation.icosphere(subdivisions=4, radius=0.02)  # the scene, as it is

pytestmark = pytest.mark.usefixtures("without_pictures")


def reconstruct_as(path, mesh):
    (path / "reconstruction").mkdir(exist_ok=True)
    (path / "reconstruction" / "mesh.ply").write_bytes(mesh.export(file_type="ply"))


@pytest.fixture
def run(fitted_run, tmp_path, monkeypatch):
    """A run that was hardly fitted, yet whose reconstruction is the true surface."""
    monkeypatch.setattr(traced_module, "RAYS", 500)
    monkeypatch.setattr(predict_module, "spectrogram_picture", lambda *given: b"")
    path = tmp_path / "run"
    path.mkdir()
    for name in ("model.safetensors", "model.json"):
        shutil.copy(fitted_run / name, path)
    reconstruct_as(path, SPHERE)
    return path


def learn(path, progress=QUIET):
    finish_module._learn_traced(Run(path), "cpu", progress)
    return load_traced(path).weight


def trace_poses(fitted, surface, poses, *, progress):
    simulation, seed = fitted.settings.simulation, fitted.settings.fit.seed
    return traced_module.trace_poses(
        surface, fitted.head, poses, simulation, seed=seed, progress=progress
    )


@pytest.fixture(scope="module")
def learned(fitted_run, without_pictures, tmp_path_factory):
    """What is learned of the true surface, as bytes."""
    path = tmp_path_factory.mktemp("learned") / "run"
    shutil.copytree(fitted_run, path)
    reconstruct_as(path, SPHERE)
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(traced_module, "RAYS", 500)
        learn(path)
    return (path / NAME).read_bytes()


@pytest.fixture
def believe(learned):
    """Put what was learned into a run, with one weight for all frequencies."""

    def put(path, share):
        digest = hashlib.sha256((path / "model.safetensors").read_bytes()).hexdigest()
        tensors = {
            **safetensors.torch.load(learned),
            "weight": torch.full((ROWS,), share, dtype=torch.float64),
        }
        tensors.pop("half_db")  # it belongs to the learned weight
        (path / NAME).write_bytes(safetensors.torch.save(tensors, {"model": digest}))

    return put


# Learning.


def test_echoes_of_the_true_surface_have_a_great_weight(run):
    weight = learn(run)
    assert weight.mean() > 0.9
    found = load_traced(run)
    np.testing.assert_array_equal(found.weight, weight)
    # Both are simulated; 500 rays give a level to some tenths of a decibel.
    np.testing.assert_allclose(found.gain_db, 0, atol=0.5)
    surface = Run(run).mesh()
    np.testing.assert_array_equal(found.mesh.vertices, surface.vertices)
    np.testing.assert_array_equal(found.mesh.faces, surface.faces)


@pytest.mark.parametrize(
    ("scale", "words"), [(1e-3, "4e-05 m large"), (1e4, "400 m large")], ids=["small", "large"]
)
def test_a_surface_that_the_simulator_refuses_is_told_and_not_traced(
    run, believe, caplog, scale, words
):
    believe(run, 1.0)
    reconstruct_as(run, SPHERE.copy().apply_scale(scale))
    assert not learn(run).any()
    (line,) = caplog.messages
    assert line.startswith("no echoes are traced off the surface: the mesh is ")
    assert words in line
    assert "\n" not in line
    kept = load_traced(run)
    assert not kept.weight.any()
    assert words in kept.fault
    predict(run, accelerator="cpu")
    assert Run(run).read_metrics()["prediction"]["traced_fault"] == kept.fault


# Tracing.


@pytest.fixture
def traceable(run):
    """A fitted run, what is traced off, and where."""
    fitted = Run(run)
    poses = fitted.echoes.poses("val")
    rows = len(fitted.model.renderer.frequency)
    return fitted, Traced(SPHERE, np.zeros((2, rows)), np.ones(rows)), poses


def test_traced_echoes_are_those_that_were_measured(traceable, echoes):
    fitted, surface, poses = traceable
    store = EnsembleStore.open(echoes)
    measured = np.stack([store.read_pose(int(number)) for number in store.indices("val")])
    traced = trace_poses(fitted, surface, poses, progress=QUIET)
    assert traced.shape == measured.shape
    reference = store.attributes["reference"]
    error = np.abs(compress(traced, reference) - compress(measured, reference)).mean()
    # Another pattern of few rays; silence, or the poses exchanged, is several decibels off.
    assert error < 0.5


def test_the_gain_applies_to_its_own_ear_and_frequency(traceable):
    fitted, surface, poses = traceable
    some = poses[0]
    plain = trace_poses(fitted, surface, some, progress=QUIET)
    gain = np.zeros_like(surface.gain_db)
    gain[0, 3], gain[1, -1] = 20, -20
    expected = plain.copy()
    expected[:, 0, :, 3] *= 10
    expected[:, 1, :, -1] /= 10
    tuned = Traced(SPHERE, gain, surface.weight)
    np.testing.assert_allclose(
        trace_poses(fitted, tuned, some, progress=QUIET), expected, rtol=1e-12
    )


# What is kept.


def of_another_fit(path):
    state, description = load_weights(path)
    state["field.region"] = 1.01 * state["field.region"]
    save_weights(path, state, description)


def test_what_belongs_to_another_fit_is_left_alone(run, believe):
    believe(run, 1.0)
    of_another_fit(run)
    kept = (run / NAME).read_bytes()
    assert load_traced(run) is None
    arrays_and_numbers(run)
    assert json.loads((run / "metrics.json").read_text())["prediction"]["traced_weight"] == 0
    assert (run / NAME).read_bytes() == kept


def test_it_says_which_fit_it_belongs_to(run):
    learn(run)
    with safetensors.safe_open(str(run / NAME), "pt") as file:
        digest = hashlib.sha256((run / "model.safetensors").read_bytes()).hexdigest()
        assert file.metadata() == {"model": digest}


DAMAGED = {
    "empty": lambda data: b"",
    "cut": lambda data: data[:-5],
    "header cut": lambda data: data[:40],
    "zeros": lambda data: bytes(len(data)),
    "nonsense": lambda data: b"<html>not found</html>" * 20,
    # Renamed, it is another tensor's.
    **{
        f"no {name}": lambda data, name=name: data.replace(name.encode(), name.upper().encode())
        for name in ("vertices", "faces", "gain_db", "weight")
    },
}


@pytest.mark.parametrize("how", DAMAGED)
def test_a_damaged_file_is_told_in_one_line_with_a_way_out(run, learned, how):
    (run / NAME).write_bytes(DAMAGED[how](learned))
    with pytest.raises(InputError, match=r"traced\.safetensors: damaged \(.*fit") as caught:
        load_traced(run)
    assert "\n" not in str(caught.value)


# Predictions.


def arrays_and_numbers(path, **options):
    folder = predict(path, accelerator="cpu", **options)
    with np.load(folder / "spectrograms.npz", allow_pickle=False) as file:
        arrays = dict(file)
    metrics = folder.parent / "metrics.json"
    if not metrics.exists():
        return arrays, None
    return arrays, json.loads(metrics.read_text())["prediction"]


def parts(path, poses):
    """What the field renders and what is traced, as a blend takes them."""
    fitted = Run(path)
    rendered = render_poses(fitted.model, poses, accelerator="cpu", progress=QUIET)
    traced = trace_poses(fitted, load_traced(path), poses, progress=QUIET)
    return rendered, traced, fitted.model.reference


@pytest.mark.parametrize("share", [0.3, 1.0])
def test_a_prediction_is_traced_as_far_as_it_is_believed(run, believe, share):
    believe(run, share)
    arrays, numbers = arrays_and_numbers(run)
    fitted = Run(run)
    poses = fitted.echoes.poses("test")
    rendered, traced, reference = parts(run, poses)
    assert arrays["predicted"].dtype == np.float32
    level = mix(compress(rendered, reference), compress(traced, reference), share)
    expected = reference * (10 ** (level / 20) - 1)
    tolerance = {"rtol": 1e-6, "atol": 1e-6 * reference}
    np.testing.assert_allclose(arrays["predicted"], expected, **tolerance)
    assert numbers["traced_weight"] == pytest.approx(share)
    measured = compress(arrays["measured"], reference)
    for key, magnitude in (("mae_db", arrays["predicted"]), ("rendered_mae_db", rendered)):
        error = np.abs(compress(magnitude, reference) - measured)
        loud = (measured >= 3) | (compress(magnitude, reference) >= 3)
        assert numbers[key] == pytest.approx(error.mean(), rel=1e-6)
        assert numbers[f"{key}_active"] == pytest.approx(error[loud].mean(), rel=1e-6)
    assert numbers["mae_db"] < numbers["rendered_mae_db"]  # off the true surface
