# SPDX-License-Identifier: MIT
"""The weight of echoes traced off the surface comes from validation poses alone."""

from __future__ import annotations

import hashlib
import json
import shutil
from contextlib import contextmanager
from dataclasses import replace

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
from sononerf.head.decibels import compress
from sononerf.progress import Progress
from sononerf.run import fit as finish_module
from sononerf.run import predict as predict_module
from sononerf.run import run as run_module
from sononerf.run.build import head_of, simulator_of
from sononerf.run.model_files import NAME, load_traced
from sononerf.run.predict import predict
from sononerf.run.run import Run
from sononerf.scene.scene import Scene
from sononerf.simulation.simulator import Simulator

CSV = "x,y,z,yaw,pitch,roll\n-0.4,0,0,0,0,0\n0,0,0.4,0,90,0\n"
QUIET = Progress(quiet=True)
ROWS = 47  # frequencies
SPHERE = trimesh.creation.icosphere(subdivisions=4, radius=0.02)  # the scene, as it is

pytestmark = pytest.mark.usefixtures("without_pictures")


class Heard(Progress):
    """Keeps what is said."""

    def __init__(self):
        super().__init__(quiet=True)
        self.said = []

    def say(self, text):
        self.said.append(text)


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


def never(*given, **options):
    raise AssertionError("this is not to be asked for")


def tree(folder):
    return {
        path: path.read_bytes() if path.is_file() else None
        for path in sorted(folder.rglob("*"))
        if path.name != ".lock"
    }


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


def test_nothing_is_traced_where_the_field_alone_is_right(run, monkeypatch):
    heard = Run(run).echoes

    def right(model, poses, **options):
        return np.stack([heard.spectrogram(int(number)) for number in heard.numbers_of(poses)])

    monkeypatch.setattr(traced_module, "render_poses", right)
    assert not learn(run).any()
    assert not load_traced(run).weight.any()


def test_the_regression_has_the_validation_poses_alone(run, monkeypatch):
    given = {}

    def noted(measured, rendered, traced):
        given.update(measured=measured, rendered=rendered, traced=traced)
        return np.full(measured.shape[-1], 0.4)

    monkeypatch.setattr(traced_module, "regress_weight", noted)
    assert (learn(run) == 0.4).all()
    fitted, surface = Run(run), load_traced(run)
    assert (surface.weight == 0.4).all()
    heard, reference = fitted.echoes, fitted.model.reference
    store = heard.store
    poses = heard.poses("val")
    measured = [store.read_pose(int(i)) for i in store.indices("val")]
    np.testing.assert_array_equal(given["measured"], compress(measured, reference))
    rendered = render_poses(fitted.model, poses, accelerator="cpu", progress=QUIET)
    np.testing.assert_array_equal(given["rendered"], compress(rendered, reference))
    traced = trace_poses(fitted, surface, poses, progress=QUIET)
    np.testing.assert_allclose(given["traced"], compress(traced, reference), rtol=1e-6, atol=1e-9)


def test_the_gain_is_of_training_poses_alone(run, monkeypatch):
    read = EnsembleStore.read_pose
    learn(run)
    gain = load_traced(run).gain_db
    louder = []
    monkeypatch.setattr(
        EnsembleStore,
        "read_pose",
        lambda self, index: read(self, index) * (2 if self.split[index] in louder else 1),
    )
    louder[:] = [1, 2]  # validation and test
    learn(run)
    np.testing.assert_array_equal(load_traced(run).gain_db, gain)
    louder[:] = [0]
    learn(run)
    # Twice the pressure is 6.02 dB; next to the threshold of 20 dB silence takes 0.45 dB of it,
    # and other cells pass the threshold.
    np.testing.assert_allclose(load_traced(run).gain_db - gain, 6.02, atol=0.7)


def test_what_is_read_of_the_echoes(run, echoes, monkeypatch):
    store = EnsembleStore.open(echoes)
    unheard = set(store.indices("test").tolist())
    assert unheard
    read, asked = EnsembleStore.read_pose, []

    def watched(self, index):
        assert index not in unheard
        asked.append(index)
        return read(self, index)

    monkeypatch.setattr(EnsembleStore, "read_pose", watched)
    monkeypatch.setattr(traced_module, "GAIN_POSES", 3)
    assert learn(run).mean() > 0.9
    train, val = store.indices("train"), store.indices("val")
    # From the first to the last, evenly.
    assert set(asked) == {*train[[0, 3, 7]].tolist(), *val.tolist()}


def test_where_is_traced(run, echoes, monkeypatch):
    traced, real = [], Simulator.spectrogram

    def watched(self, position, rotation, *, seed):
        traced.append(position)
        return real(self, position, rotation, seed=seed)

    monkeypatch.setattr(Simulator, "spectrogram", watched)
    learn(run)
    store = EnsembleStore.open(echoes)
    numbers = np.concatenate([store.indices("train"), store.indices("val")])
    np.testing.assert_allclose(traced, store.positions[numbers], rtol=1e-6)


def test_nothing_but_its_own_file_is_written(run, echoes, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    before = tree(tmp_path), tree(echoes)
    learn(run)
    after = tree(tmp_path)
    assert after.pop(run / NAME)
    assert (after, tree(echoes)) == before


def test_the_same_run_gives_the_same_bits(run):
    learn(run)
    first = (run / NAME).read_bytes()
    learn(run)
    assert (run / NAME).read_bytes() == first


def without(split, patch):
    indices = EnsembleStore.indices
    patch.setattr(
        EnsembleStore,
        "indices",
        lambda self, asked: indices(self, asked)[: 0 if asked == split else None],
    )


def no_validation(path, patch):
    without("val", patch)


def test_no_test_poses_are_needed_to_learn(run, monkeypatch):
    expected = learn(run)
    without("test", monkeypatch)
    np.testing.assert_array_equal(learn(run), expected)


class Counted(Progress):
    """Counts the frequencies that are solved for."""

    def __init__(self):
        super().__init__(quiet=True)
        self.tasks = []

    @contextmanager
    def task(self, what, total):
        with super().task(what, total) as task:
            self.tasks.append(task)
            yield task

    @property
    def solved(self):
        return sum(task.done for task in self.tasks if task.what == "solving")


def test_the_low_band_is_solved_once_for_learning_and_predicting(run):
    description = json.loads((run / "model.json").read_text())
    description["settings"]["simulation"]["sources"] = 300
    (run / "model.json").write_text(json.dumps(description))
    progress, opened = Counted(), Run(run)
    finish_module._learn_traced(opened, "cpu", progress)
    solved = progress.solved
    assert solved > 0
    shared, _ = arrays_and_numbers(opened, progress=progress)
    assert progress.solved == solved
    alone, _ = arrays_and_numbers(run, progress=progress)
    assert progress.solved > solved
    np.testing.assert_array_equal(shared["predicted"], alone["predicted"])


def switched_off(path, patch):
    description = json.loads((path / "model.json").read_text())
    description["settings"]["prediction"] = {"traced": "off"}
    (path / "model.json").write_text(json.dumps(description))


@pytest.mark.parametrize("why", [no_validation, switched_off])
def test_what_cannot_be_borne_out_or_is_not_wanted_is_not_traced(run, believe, monkeypatch, why):
    believe(run, 1.0)  # as an earlier fit may have left it
    why(run, monkeypatch)
    monkeypatch.setattr(Simulator, "__init__", never)
    monkeypatch.setattr(traced_module, "render_poses", never)
    heard = Heard()
    assert not learn(run, progress=heard).any()
    assert heard.said == []
    assert not load_traced(run).weight.any()


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


def test_a_mesh_that_is_gone_or_damaged_is_an_error(run):
    (run / "reconstruction" / "mesh.ply").write_bytes(b"ply\nnonsense")
    with pytest.raises(InputError, match=r"mesh\.ply: damaged.*reconstruct again"):
        learn(run)
    (run / "reconstruction" / "mesh.ply").unlink()
    with pytest.raises(InputError, match=r"mesh\.ply"):
        learn(run)
    assert not (run / NAME).exists()


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


@pytest.mark.parametrize(
    ("section", "values"),
    [
        ("noise", {"snr_db": (0.0, 0.0)}),
        ("simulation", {"engine": "rays"}),
        ("simulation", {"rays": 7}),
    ],
)
def test_noise_engine_and_rays_of_the_experiment_are_left_out(traceable, section, values):
    fitted, surface, poses = traceable
    changed = getattr(fitted.settings, section).model_copy(update=values)
    settings = fitted.settings.model_copy(update={section: changed})
    assert settings != fitted.settings
    other = Run(fitted.path)
    other.__dict__["_model"] = replace(fitted._model, settings=settings)
    other.model.head = head_of(settings)
    some = poses[0]
    np.testing.assert_array_equal(
        trace_poses(other, surface, some, progress=QUIET),
        trace_poses(fitted, surface, some, progress=QUIET),
    )


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


def test_what_was_never_learned_is_not_there(run):
    assert load_traced(run) is None


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


@pytest.mark.parametrize(
    ("name", "value"),
    [
        ("vertices", float("nan")),
        ("gain_db", float("inf")),
        ("weight", -0.1),
        ("weight", 1.1),
        ("weight", float("nan")),
        ("faces", -1),
        ("faces", 1_000_000),
    ],
)
def test_what_cannot_be_is_damage(run, learned, name, value):
    tensors = safetensors.torch.load(learned)
    tensors[name].view(-1)[:1] = value
    digest = hashlib.sha256((run / "model.safetensors").read_bytes()).hexdigest()
    (run / NAME).write_bytes(safetensors.torch.save(tensors, {"model": digest}))
    with pytest.raises(InputError, match=r"traced\.safetensors: damaged \(.*fit"):
        load_traced(run)


def test_a_damaged_file_is_told_before_a_folder_is_made(run, learned, tmp_path):
    (run / NAME).write_bytes(learned[:-5])
    with pytest.raises(InputError, match="damaged"):
        predict(run, accelerator="cpu", output=tmp_path / "elsewhere")
    assert not (tmp_path / "elsewhere").exists()


def test_nothing_is_predicted_with_a_damaged_file_until_it_is_made_anew(run, learned):
    (run / NAME).write_bytes(learned[:-5])
    with pytest.raises(InputError, match="damaged"):
        predict(run, accelerator="cpu")
    assert not (run / "metrics.json").exists()
    assert learn(run).mean() > 0.9
    assert (run / NAME).read_bytes() == learned


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


def test_a_prediction_without_belief_is_the_rendering(run, believe):
    never_learned, numbers = arrays_and_numbers(run)
    fitted = Run(run)
    poses = fitted.echoes.poses("test")
    rendered = render_poses(fitted.model, poses, accelerator="cpu", progress=QUIET)
    np.testing.assert_array_equal(never_learned["predicted"], rendered)
    believe(run, 0.0)
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(Simulator, "__init__", never)
        unbelieved, same = arrays_and_numbers(run)
    np.testing.assert_array_equal(unbelieved["predicted"], rendered)
    assert same == numbers
    assert numbers["traced_weight"] == 0
    assert numbers["rendered_mae_db"] == numbers["mae_db"]
    assert numbers["rendered_mae_db_active"] == numbers["mae_db_active"]


def test_poses_of_ones_own_are_traced_off_the_run_without_store_or_scene(
    run, believe, tmp_path, monkeypatch
):
    believe(run, 1.0)
    (run / "reconstruction" / "mesh.ply").unlink()
    monkeypatch.setattr(EnsembleStore, "read_pose", never)
    monkeypatch.setattr(run_module, "find_ensemble", never)
    (tmp_path / "poses.csv").write_text(CSV)
    arrays, numbers = arrays_and_numbers(run, poses_csv=tmp_path / "poses.csv")
    assert numbers is None
    fitted = Run(run)
    simulator = simulator_of(Scene(load_traced(run).mesh), fitted.settings)
    mine = np.stack(
        [
            simulator.spectrogram(position.astype(float), rotation.astype(float), seed=0)
            for position, rotation in zip(arrays["position"], arrays["rotation"], strict=True)
        ]
    )
    reference = fitted.model.reference
    # The settings have 500 rays as well; what differs is the gain, some tenths of a decibel.
    np.testing.assert_allclose(
        compress(arrays["predicted"], reference), compress(mine, reference), atol=0.5
    )
