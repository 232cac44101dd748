# SPDX-License-Identifier: MIT
"""Echoes off the reconstruction are believed as far as unseen poses bear them out, no further."""

from __future__ import annotations

import hashlib
import json
import shutil

import numpy as np
import pytest
import safetensors.torch
import torch
import trimesh

from sononerf.acoustics.spectrogram import compress
from sononerf.data.store import EnsembleStore
from sononerf.errors import InputError, NumericalError
from sononerf.experiment import predict as predict_module
from sononerf.experiment import retrace as retrace_module
from sononerf.experiment.borne_out import NAME, borne_out
from sononerf.experiment.fitted import load_fitted, poses_of, render_poses, store_of
from sononerf.experiment.predict import predict
from sononerf.experiment.reconstruct import read_mesh, reconstruct
from sononerf.experiment.retrace import Retrace, learn_retrace, load_retrace, trace_poses
from sononerf.progress import Progress
from sononerf.reconstruction.retrace import blend, calmed
from sononerf.scene import Scene
from sononerf.simulation.simulator import Simulator
from sononerf.weights import load_weights, save_weights

CSV = "x,y,z,yaw,pitch,roll\n-0.4,0,0,0,0,0\n0,0,0.4,0,90,0\n"
QUIET = Progress(quiet=True)
SPHERE = trimesh.creation.icosphere(subdivisions=4, radius=0.02)  # the scene, as it is

pytestmark = pytest.mark.usefixtures("without_pictures")


class Heard(Progress):
    """Keeps what is said."""

    def __init__(self):
        super().__init__(quiet=True)
        self.said = []

    def say(self, text):
        self.said.append(text)


def no_hull(fitted):
    raise NumericalError("first echoes leave nothing")


def reconstruct_as(path, mesh):
    (path / "reconstruction").mkdir(exist_ok=True)
    (path / "reconstruction" / "mesh.ply").write_bytes(mesh.export(file_type="ply"))


@pytest.fixture
def run(fitted_run, tmp_path, monkeypatch):
    """A run that was hardly fitted, yet whose reconstruction is the true surface."""
    monkeypatch.setattr(retrace_module, "RAYS", 500)
    monkeypatch.setattr(retrace_module, "_hull_surface", no_hull)
    monkeypatch.setattr(predict_module, "spectrogram_png", lambda *given: b"")
    path = tmp_path / "run"
    path.mkdir()
    for name in ("model.safetensors", "model.json"):
        shutil.copy(fitted_run / name, path)
    reconstruct_as(path, SPHERE)
    return path


def learn(path, **options):
    return learn_retrace(path, accelerator="cpu", **options)


@pytest.fixture(scope="module")
def learned(fitted_run, without_pictures, tmp_path_factory):
    """What is learned of the true surface, as bytes."""
    path = tmp_path_factory.mktemp("learned") / "run"
    shutil.copytree(fitted_run, path)
    reconstruct_as(path, SPHERE)
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(retrace_module, "RAYS", 500)
        patch.setattr(retrace_module, "_hull_surface", no_hull)
        learn(path)
    return (path / NAME).read_bytes()


@pytest.fixture
def believe(learned):
    """Put what was learned into a run, with a share of one's own."""

    def put(path, share):
        digest = hashlib.sha256((path / "model.safetensors").read_bytes()).hexdigest()
        tensors = {
            **safetensors.torch.load(learned),
            "share": torch.tensor(share, dtype=torch.float64),
        }
        (path / NAME).write_bytes(safetensors.torch.save(tensors, {"model": digest}))

    return put


def never(*given, **options):
    raise AssertionError("this is not to be asked for")


def tree(folder):
    return {
        path: path.read_bytes() if path.is_file() else None for path in sorted(folder.rglob("*"))
    }


# Learning.


def test_a_true_surface_is_believed_whole(run):
    assert learn(run) == 1
    found = load_retrace(run)
    assert found.share == 1
    # Both are simulated; 500 rays tell a level to some tenths of a decibel.
    np.testing.assert_allclose(found.gain_db, 0, atol=0.5)
    surface = calmed(read_mesh(run / "reconstruction" / "mesh.ply"))
    np.testing.assert_array_equal(found.mesh.vertices, surface.vertices)
    np.testing.assert_array_equal(found.mesh.faces, surface.faces)


def test_where_the_field_alone_is_right_nothing_is_traced(run, monkeypatch):
    def right(fitted, poses, **options):
        return np.concatenate([poses[row].spectrum.numpy() for row in range(len(poses))])

    monkeypatch.setattr(retrace_module, "render_poses", right)
    assert learn(run) == 0
    assert load_retrace(run).share == 0


def test_the_share_is_that_of_rendered_and_tuned_echoes_of_the_validation_poses(run, monkeypatch):
    given = {}

    def noted(measured, rendered, traced, reference):
        given.update(measured=measured, rendered=rendered, traced=traced, reference=reference)
        return 0.4

    monkeypatch.setattr(retrace_module, "best_share", noted)
    assert learn(run) == 0.4
    fitted, retrace = load_fitted(run), load_retrace(run)
    assert retrace.share == 0.4
    store = store_of(fitted)
    poses = poses_of(store, "val", fitted.module.renderer)
    numbers = store.indices("val")
    np.testing.assert_array_equal(given["measured"], [store.read_pose(int(i)) for i in numbers])
    rendered = render_poses(fitted, poses, accelerator="cpu", progress=QUIET)
    np.testing.assert_array_equal(given["rendered"], rendered)
    traced = trace_poses(fitted.settings, retrace, poses, progress=QUIET)
    np.testing.assert_array_equal(given["traced"], traced)
    assert given["reference"] == fitted.module.reference


def test_the_gain_is_of_training_poses_alone(run, monkeypatch):
    read = EnsembleStore.read_pose
    learn(run)
    gain = load_retrace(run).gain_db
    louder = []
    monkeypatch.setattr(
        EnsembleStore,
        "read_pose",
        lambda self, index: read(self, index) * (2 if self.split[index] in louder else 1),
    )
    louder[:] = [1, 2]  # validation and test
    learn(run)
    np.testing.assert_array_equal(load_retrace(run).gain_db, gain)
    louder[:] = [0]
    learn(run)
    # Twice the pressure is 6.02 dB; next to the threshold of 20 dB silence takes 0.45 dB of it,
    # and other cells pass the threshold.
    np.testing.assert_allclose(load_retrace(run).gain_db - gain, 6.02, atol=0.7)


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
    monkeypatch.setattr(retrace_module, "GAIN_POSES", 3)
    assert learn(run) == 1
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


def no_validation(path, patch):
    indices = EnsembleStore.indices
    patch.setattr(
        EnsembleStore,
        "indices",
        lambda self, split: indices(self, split)[: 0 if split == "val" else None],
    )


def switched_off(path, patch):
    description = json.loads((path / "model.json").read_text())
    description["settings"]["prediction"] = {"traced": "off"}
    (path / "model.json").write_text(json.dumps(description))


@pytest.mark.parametrize("why", [no_validation, switched_off])
def test_what_cannot_be_borne_out_or_is_not_wanted_is_not_traced(run, believe, monkeypatch, why):
    believe(run, 1.0)  # as an earlier fit may have left it
    why(run, monkeypatch)
    monkeypatch.setattr(Simulator, "from_settings", never)
    monkeypatch.setattr(retrace_module, "render_poses", never)
    heard = Heard()
    assert learn(run, progress=heard) == 0
    assert heard.said == []
    assert load_retrace(run).share == 0


@pytest.mark.parametrize(
    ("scale", "words"), [(1e-3, "4e-05 m large"), (1e4, "400 m large")], ids=["small", "large"]
)
def test_a_surface_that_the_simulator_refuses_is_told_and_not_traced(run, believe, scale, words):
    believe(run, 1.0)
    reconstruct_as(run, SPHERE.copy().apply_scale(scale))
    heard = Heard()
    assert learn(run, progress=heard) == 0
    (line,) = heard.said
    assert line.startswith("no echoes are traced off the mesh: the mesh is ")
    assert words in line
    assert "\n" not in line
    assert load_retrace(run).share == 0
    predict(run, accelerator="cpu")


def test_a_mesh_that_is_gone_or_damaged_is_an_error(run):
    (run / "reconstruction" / "mesh.ply").write_bytes(b"ply\nnonsense")
    with pytest.raises(InputError, match=r"mesh\.ply: damaged.*reconstruct again"):
        learn(run)
    (run / "reconstruction" / "mesh.ply").unlink()
    with pytest.raises(InputError, match=r"mesh\.ply"):
        learn(run)
    assert not (run / NAME).exists()


# The hull of first echoes in place of the mesh.

DENTED = SPHERE.copy()
DENTED.vertices[DENTED.vertices[:, 0] > 0.005, 0] = 0.005


@pytest.fixture
def hull(run, monkeypatch):
    """Say what the first echoes leave; keep how the run is reconstructed for it."""
    asked = []

    def redrawn(path, *, method, progress):
        asked.append(method)

    def put(mesh):
        monkeypatch.setattr(retrace_module, "_hull_surface", lambda fitted: mesh)
        return asked

    monkeypatch.setattr(retrace_module, "reconstruct", redrawn)
    return put


def test_the_hull_is_the_surface_where_unseen_poses_bear_it_out(run, hull):
    reconstruct_as(run, DENTED)
    asked, heard = hull(SPHERE), Heard()
    assert learn(run, progress=heard) == 1
    assert asked == ["hull"]
    assert borne_out(run) == "hull"
    np.testing.assert_array_equal(load_retrace(run).mesh.vertices, calmed(SPHERE).vertices)
    np.testing.assert_allclose(load_retrace(run).gain_db, 0, atol=0.5)
    assert [text for text in heard.said if "hull of first echoes" in text] == heard.said[-1:]


def test_the_mesh_stays_where_the_hull_is_no_better(run, hull):
    asked = hull(DENTED)
    assert learn(run) == 1
    assert asked == []
    assert borne_out(run) == "auto"
    np.testing.assert_array_equal(
        load_retrace(run).mesh.vertices,
        calmed(read_mesh(run / "reconstruction" / "mesh.ply")).vertices,
    )


def test_of_two_that_nobody_believes_the_mesh_stays(run, hull, monkeypatch):
    reconstruct_as(run, DENTED)
    asked = hull(SPHERE)
    monkeypatch.setattr(retrace_module, "best_share", lambda *given: 0.0)
    assert learn(run) == 0
    assert asked == []
    assert borne_out(run) == "auto"


def test_a_hull_may_be_traced_where_the_mesh_cannot(run, hull):
    reconstruct_as(run, SPHERE.copy().apply_scale(1e-3))
    asked = hull(SPHERE)
    assert learn(run) == 1
    assert asked == ["hull"]


def settings_of(path, **changed):
    description = json.loads((path / "model.json").read_text())
    description["settings"]["reconstruction"].update(changed)
    (path / "model.json").write_text(json.dumps(description))


@pytest.mark.parametrize("changed", [{"method": "oriented"}, {"level": 0.4}])
def test_who_says_how_the_surface_is_found_is_obeyed(run, monkeypatch, changed):
    settings_of(run, **changed)
    reconstruct_as(run, DENTED)
    monkeypatch.setattr(retrace_module, "_hull_surface", never)
    learn(run)
    assert borne_out(run) == "auto"


@pytest.mark.parametrize("spacing", [None, 0.003])
def test_the_hull_is_that_of_the_reconstruction(run, monkeypatch, spacing):
    settings_of(run, spacing=spacing)
    monkeypatch.undo()
    found = retrace_module._hull_surface(load_fitted(run))
    folder = reconstruct(run, method="hull", output=run / "hull")
    np.testing.assert_allclose(
        read_mesh(folder / "mesh.ply").bounds, found.bounds, rtol=0, atol=1e-6
    )


# Tracing.


@pytest.fixture
def traceable(run):
    """Settings, what is traced off, and where."""
    fitted = load_fitted(run)
    poses = poses_of(store_of(fitted), "val", fitted.module.renderer)
    retrace = Retrace(SPHERE, np.zeros(len(fitted.module.renderer.frequency)), 1.0)
    return fitted.settings, retrace, poses


def test_traced_echoes_are_those_that_were_measured(traceable, echoes):
    settings, retrace, poses = traceable
    store = EnsembleStore.open(echoes)
    measured = np.stack([store.read_pose(int(number)) for number in poses.numbers])
    traced = trace_poses(settings, retrace, poses, progress=QUIET)
    assert traced.shape == measured.shape
    reference = store.attributes["reference"]
    error = np.abs(compress(traced, reference) - compress(measured, reference)).mean()
    # Another pattern of few rays; silence, or the poses exchanged, is several decibels off.
    assert error < 0.5


@pytest.mark.parametrize(
    ("section", "values"),
    [
        ("noise", {"snr_db": (0.0, 0.0)}),
        ("simulation", {"engine": "kirchhoff"}),
        ("simulation", {"rays": 7}),
    ],
)
def test_noise_engine_and_rays_of_the_experiment_are_left_out(traceable, section, values):
    settings, retrace, poses = traceable
    changed = getattr(settings, section).model_copy(update=values)
    other = settings.model_copy(update={section: changed})
    assert other != settings
    some = poses.only(torch.tensor([0]))
    np.testing.assert_array_equal(
        trace_poses(other, retrace, some, progress=QUIET),
        trace_poses(settings, retrace, some, progress=QUIET),
    )


def test_the_gain_is_laid_on_its_own_frequency(traceable):
    settings, retrace, poses = traceable
    some = poses.only(torch.tensor([0]))
    plain = trace_poses(settings, retrace, some, progress=QUIET)
    gain = np.zeros_like(retrace.gain_db)
    gain[3], gain[-1] = 20, -20
    expected = plain.copy()
    expected[..., 3] *= 10
    expected[..., -1] /= 10
    tuned = Retrace(SPHERE, gain, retrace.share)
    np.testing.assert_allclose(
        trace_poses(settings, tuned, some, progress=QUIET), expected, rtol=1e-12
    )


# What is kept.


def test_what_was_never_learned_is_not_there(run):
    assert load_retrace(run) is None


def of_another_fit(path):
    state, description = load_weights(path)
    state["field.region"] = 1.01 * state["field.region"]
    save_weights(path, state, description)


def test_what_belongs_to_another_fit_is_left_alone(run, believe):
    believe(run, 1.0)
    of_another_fit(run)
    kept = (run / NAME).read_bytes()
    assert load_retrace(run) is None
    arrays_and_numbers(run)
    assert json.loads((run / "metrics.json").read_text())["prediction"]["traced_share"] == 0
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
        for name in ("vertices", "faces", "gain_db", "share")
    },
}


@pytest.mark.parametrize("how", DAMAGED)
def test_a_damaged_file_is_told_in_one_line_with_a_way_out(run, learned, how):
    (run / NAME).write_bytes(DAMAGED[how](learned))
    with pytest.raises(InputError, match=r"retrace\.safetensors: damaged \(.*fit") as caught:
        load_retrace(run)
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize(
    ("name", "value"),
    [
        ("vertices", float("nan")),
        ("gain_db", float("inf")),
        ("share", -0.1),
        ("share", 1.1),
        ("share", float("nan")),
        ("faces", -1),
        ("faces", 1_000_000),
    ],
)
def test_what_cannot_be_is_damage(run, learned, name, value):
    tensors = safetensors.torch.load(learned)
    tensors[name].view(-1)[:1] = value
    digest = hashlib.sha256((run / "model.safetensors").read_bytes()).hexdigest()
    (run / NAME).write_bytes(safetensors.torch.save(tensors, {"model": digest}))
    with pytest.raises(InputError, match=r"retrace\.safetensors: damaged \(.*fit"):
        load_retrace(run)


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
    assert learn(run) == 1
    assert (run / NAME).read_bytes() == learned


# Predictions.


def arrays_and_numbers(path, **options):
    folder = predict(path, accelerator="cpu", **options)
    with np.load(folder / "spectrograms.npz", allow_pickle=False) as file:
        arrays = dict(file)
    if not (path / "metrics.json").exists():
        return arrays, None
    return arrays, json.loads((path / "metrics.json").read_text())["prediction"]


def parts(path, poses):
    """What the field renders and what is traced, as a blend takes them."""
    fitted = load_fitted(path)
    rendered = render_poses(fitted, poses, accelerator="cpu", progress=QUIET)
    traced = trace_poses(fitted.settings, load_retrace(path), poses, progress=QUIET)
    return rendered, traced, fitted.module.reference


@pytest.mark.parametrize("share", [0.3, 1.0])
def test_a_prediction_is_traced_as_far_as_it_is_believed(run, believe, share):
    believe(run, share)
    arrays, numbers = arrays_and_numbers(run)
    fitted = load_fitted(run)
    poses = poses_of(store_of(fitted), "test", fitted.module.renderer)
    rendered, traced, reference = parts(run, poses)
    assert arrays["predicted"].dtype == np.float32
    expected = traced if share == 1 else blend(rendered, traced, share, reference)
    tolerance = {"rtol": 1e-6, "atol": 1e-6 * reference}
    np.testing.assert_allclose(arrays["predicted"], expected, **tolerance)
    assert numbers["traced_share"] == share
    measured = compress(arrays["measured"], reference)
    for key, magnitude in (("mae_db", arrays["predicted"]), ("rendered_mae_db", rendered)):
        error = np.abs(compress(magnitude, reference) - measured)
        loud = (measured >= 3) | (compress(magnitude, reference) >= 3)
        assert numbers[key] == pytest.approx(error.mean(), rel=1e-6)
        assert numbers[f"{key}_active"] == pytest.approx(error[loud].mean(), rel=1e-6)
    assert numbers["mae_db"] < numbers["rendered_mae_db"]  # off the true surface


def test_a_prediction_without_belief_is_the_rendering(run, believe):
    never_learned, numbers = arrays_and_numbers(run)
    fitted = load_fitted(run)
    poses = poses_of(store_of(fitted), "test", fitted.module.renderer)
    rendered = render_poses(fitted, poses, accelerator="cpu", progress=QUIET)
    np.testing.assert_array_equal(never_learned["predicted"], rendered)
    believe(run, 0.0)
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(Simulator, "from_settings", never)
        unbelieved, same = arrays_and_numbers(run)
    np.testing.assert_array_equal(unbelieved["predicted"], rendered)
    assert same == numbers
    assert numbers["traced_share"] == 0
    assert numbers["rendered_mae_db"] == numbers["mae_db"]
    assert numbers["rendered_mae_db_active"] == numbers["mae_db_active"]


def test_poses_of_ones_own_are_traced_off_the_run_without_store_or_scene(
    run, believe, tmp_path, monkeypatch
):
    believe(run, 1.0)
    (run / "reconstruction" / "mesh.ply").unlink()
    monkeypatch.setattr(EnsembleStore, "read_pose", never)
    monkeypatch.setattr(predict_module, "store_of", never)
    (tmp_path / "poses.csv").write_text(CSV)
    arrays, numbers = arrays_and_numbers(run, poses_csv=tmp_path / "poses.csv")
    assert numbers is None
    fitted = load_fitted(run)
    simulator = Simulator.from_settings(Scene(load_retrace(run).mesh), fitted.settings)
    mine = np.stack(
        [
            simulator.spectrogram(position.astype(float), rotation.astype(float), seed=0)
            for position, rotation in zip(arrays["position"], arrays["rotation"], strict=True)
        ]
    )
    reference = fitted.module.reference
    # The settings have 500 rays as well; what differs is the gain, some tenths of a decibel.
    np.testing.assert_allclose(
        compress(arrays["predicted"], reference), compress(mine, reference), atol=0.5
    )
