# SPDX-License-Identifier: MIT
"""A fit that is interrupted, however often and wherever, ends where the uninterrupted one ends."""

from __future__ import annotations

import dataclasses
import importlib.metadata
import json
import os
import signal
from pathlib import Path

import lightning
import numpy as np
import pytest
import safetensors.torch
import torch
import trimesh
from lightning.fabric.utilities.rank_zero import rank_zero_only
from lightning.pytorch.callbacks import ModelCheckpoint

from sononerf import resources, storage
from sononerf.callbacks import SIGNALS, ProgressCallback
from sononerf.echoes.echoes import Echoes
from sononerf.echoes.store import EnsembleStore
from sononerf.errors import (
    IncompatibleError,
    InputError,
    LockedError,
    NumericalError,
    ResourceError,
    StoppedError,
)
from sononerf.field.datamodule import EchoDataModule
from sononerf.field.fitting import quiet_lightning, usable_accelerator
from sononerf.field.module import EchoModule
from sononerf.geometry.poses import Poses
from sononerf.head.directivity_files import write_sofa
from sononerf.head.head import Head
from sononerf.progress import Progress
from sononerf.run import fit as fit_module
from sononerf.run.fit import LINE_WARNING, fit, fit_warnings, peak_memory_bytes
from sononerf.run.predict import predict
from sononerf.run.reconstruct import reconstruct
from sononerf.run.run import STAGES, Run
from sononerf.run.simulate import head_of
from tests.head.directivity.patterns import pair

STEPS, PER_EPOCH = 12, 4

pytestmark = pytest.mark.usefixtures("without_pictures")


@pytest.fixture
def interrupt(monkeypatch):
    """Send a signal to ourselves at the end of a step."""
    real = ProgressCallback.on_train_batch_end
    wanted = {}

    def on_train_batch_end(self, trainer, pl_module, *rest):
        real(self, trainer, pl_module, *rest)
        if (number := wanted.pop(pl_module.global_step, None)) is not None:
            os.kill(os.getpid(), number)

    monkeypatch.setattr(ProgressCallback, "on_train_batch_end", on_train_batch_end)
    return wanted.__setitem__


def run(settings, path, **options):
    return fit(settings, path, accelerator="cpu", workers=1, **options)


def what_a_run_holds(path):
    """Weights as bits, steps, and what each epoch left."""
    weights = safetensors.torch.load_file(path / "model.safetensors")
    epochs = sorted((path / "epochs").iterdir())  # coarse meshes, metrics
    return {
        **{name: (tensor.dtype, tensor.numpy().tobytes()) for name, tensor in weights.items()},
        "previews": [sorted((f.name, f.read_bytes()) for f in p.iterdir()) for p in epochs],
        "epochs": [p.name for p in epochs],
        "steps": json.loads((path / "metrics.json").read_text())["cost"]["steps"],
    }


def differences(found, wanted):
    assert found.keys() == wanted.keys()
    return [name for name in wanted if found[name] != wanted[name]]


@pytest.fixture(scope="module")
def uninterrupted(tiny_settings, without_pictures, tmp_path_factory):
    """What the fit leaves where nothing happens to it."""
    path = tmp_path_factory.mktemp("uninterrupted") / "run"
    run(tiny_settings(), path)
    held = what_a_run_holds(path)
    assert held["steps"] == STEPS
    assert held["epochs"] == ["0001", "0002", "0003"]
    return held


def run_with_stops(settings, path, interrupt, stops, number=signal.SIGTERM):
    for step in stops:
        interrupt(step, number)
        with pytest.raises(StoppedError, match=f"stopped at step {step} of {STEPS}") as caught:
            run(settings, path)
        assert caught.value.exit_code == 128 + number
        assert not (path / "model.json").exists()
    interrupt(1, number)  # a step that is behind it does not come again
    run(settings, path)
    return what_a_run_holds(path)


ANYWHERE = pytest.param(list(range(1, 11)), marks=pytest.mark.slow)


@pytest.mark.parametrize(
    "stops", [[1], [PER_EPOCH], [3, PER_EPOCH, PER_EPOCH + 1], ANYWHERE], ids=str
)
def test_interrupted_fits_end_bit_for_bit_alike(tiny, tmp_path, interrupt, uninterrupted, stops):
    held = run_with_stops(tiny(), tmp_path / "run", interrupt, stops)
    assert differences(held, uninterrupted) == []


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGHUP])  # SIGTERM is above
def test_every_signal_stops_in_order_and_gives_back_its_handler(
    tiny, tmp_path, interrupt, uninterrupted, number
):
    before = [signal.getsignal(each) for each in SIGNALS]
    held = run_with_stops(tiny(), tmp_path / "run", interrupt, [5], number)
    assert differences(held, uninterrupted) == []
    assert [signal.getsignal(each) for each in SIGNALS] == before


def test_a_signal_at_the_last_step_stops_what_would_follow_the_fit(
    tiny, tmp_path, interrupt, uninterrupted
):
    interrupt(STEPS, signal.SIGTERM)
    with pytest.raises(StoppedError, match="after the last step"):
        run(tiny(), tmp_path / "run")
    assert differences(what_a_run_holds(tmp_path / "run"), uninterrupted) == []


# Canaries: where something that resuming rests on is taken away, the tests above must see it.


def test_without_validation_poses_epochs_are_still_ours(tiny, tmp_path, interrupt):
    settings = tiny(poses={"validation": 0, "heldout": 0}, data={"store": str(tmp_path / "store")})
    run(settings, tmp_path / "through")
    held = run_with_stops(settings, tmp_path / "stopped", interrupt, [PER_EPOCH, 6])
    assert differences(held, what_a_run_holds(tmp_path / "through")) == []
    assert held["epochs"] == ["0001", "0002", "0003"]


@pytest.mark.slow  # processes that import torch
def test_the_number_of_loading_processes_moves_no_bit(
    tiny, tmp_path, interrupt, uninterrupted, echoes
):
    settings = tiny(data={"store": str(echoes), "workers": 2})
    held = run_with_stops(settings, tmp_path / "run", interrupt, [6])
    assert differences(held, uninterrupted) == []


def files(folder):
    return {
        str(p.relative_to(folder)): (p.read_bytes(), p.stat().st_mtime_ns)
        for p in folder.rglob("*")
        if p.is_file()
    }


@pytest.fixture(scope="module")
def finished(tiny_settings, without_pictures, tmp_path_factory):
    path = tmp_path_factory.mktemp("finished") / "run"
    run(tiny_settings(), path)
    return path


def test_a_finished_run_is_left_as_it_is(tiny, finished):
    before = files(finished)
    found = run(tiny(data={"memory_bytes": 10**9}, fit={"checkpoint_seconds": 5}), finished)
    assert found.is_done("fit")
    assert files(finished) == before


@pytest.mark.slow
def test_more_epochs_go_on_and_the_stages_after_them_are_done_again(tiny, tmp_path):
    path = tmp_path / "run"
    run(tiny(), path)
    before = what_a_run_holds(path)
    opened = Run(path)
    reconstruct(path, accelerator="cpu")
    opened.write_metrics("prediction", {})
    run(tiny(fit={"epochs": 5}), path)
    after = what_a_run_holds(path)
    assert (after["steps"], after["epochs"]) == (20, ["0001", "0002", "0003", "0004", "0005"])
    assert after["previews"][:3] == before["previews"]  # it did not begin anew
    assert "field.grids.0" in differences({**after, "previews": before["previews"]}, before)
    assert [stage for stage in STAGES if opened.is_done(stage)] == ["fit"]
    with pytest.raises(IncompatibleError, match=r"other settings \(fit\.epochs\)"):
        run(tiny(fit={"epochs": 4}), path)


def test_other_settings_are_refused_by_name(tiny, finished):
    before = files(finished)
    with pytest.raises(IncompatibleError, match=r"other settings \(fit\.epochs, poses\.radius\)"):
        run(tiny(fit={"epochs": 4}, poses={"radius": 0.5}), finished)
    assert files(finished) == before


def test_overwrite_leaves_a_run_at_work_and_other_peoples_folders_alone(tiny, tmp_path):
    path = tmp_path / "run"
    run(tiny(fit={"max_steps": 1}), path)
    with storage.lock(path), pytest.raises(LockedError, match="in use"):
        run(tiny(fit={"max_steps": 2}), path, overwrite=True)
    assert (path / "model.json").is_file()
    thesis = tmp_path / "thesis"
    thesis.mkdir()
    (thesis / "chapter.txt").write_text("mine")
    with pytest.raises(InputError, match=r"holds 'chapter\.txt' and is no run"):
        run(tiny(), thesis, overwrite=True)
    assert files(thesis).keys() == {"chapter.txt"}


def test_what_fails_before_the_fit_leaves_no_run(tiny, tmp_path):
    deaf = tiny(
        spectrogram={"range_min": 1.0, "range_max": 1.1}, data={"store": str(tmp_path / "store")}
    )
    with pytest.raises(NumericalError, match="no pose received an echo"):
        run(deaf, tmp_path / "kept" / "runs" / "run")
    assert not (tmp_path / "kept").exists()
    (tmp_path / "kept").mkdir()
    with pytest.raises(NumericalError, match="no pose received an echo"):
        run(deaf, tmp_path / "kept" / "runs" / "run")
    assert (tmp_path / "kept").exists()
    assert not (tmp_path / "kept" / "runs").exists()


def test_a_run_holds_what_its_training_poses_heard_first(finished, echoes, tiny):
    hull = Echoes(EnsembleStore.open(echoes), head_of(tiny())).hull
    held = safetensors.torch.load_file(finished / "model.safetensors")
    names = {name for name in held if name.startswith("hull.")}
    assert names == {f"hull.{name}" for name in hull.ARRAYS}
    for name in hull.ARRAYS:
        assert held[f"hull.{name}"].dtype == torch.float64
        np.testing.assert_array_equal(held[f"hull.{name}"], getattr(hull, name))
    # The sphere's front, 20 mm before its middle, within what its echo is not an impulse.
    way = np.linalg.norm(hull.sources, axis=1) - 0.02
    np.testing.assert_allclose(held["hull.first"].mean(dim=1), way, atol=0.0005)


def test_provenance_names_no_people_machines_or_folders(finished):
    text = (finished / "provenance.json").read_text()
    assert json.loads(text)["packages"]["torch"] == importlib.metadata.version("torch")
    assert json.loads(text)["echo_hash"]
    for secret in (os.uname().nodename, str(finished.parent), f"{Path.home()}/"):
        assert secret not in text


def test_a_gpu_that_is_not_there_or_apples(tiny, tmp_path, monkeypatch):
    monkeypatch.setattr(torch.cuda, "is_available", lambda: False)
    monkeypatch.setattr(torch.backends.mps, "is_available", lambda: True)
    with pytest.raises(ResourceError, match="--accelerator cpu"):
        fit(tiny(), tmp_path / "run", accelerator="gpu")
    assert not (tmp_path / "run").exists()
    assert usable_accelerator("auto") == "cpu"


def test_memory_is_counted_in_bytes():
    assert 50_000_000 < peak_memory_bytes() < 1_000_000_000_000


def line(count):
    return [[0.0, 0.03 * (n - (count - 1) / 2), 0.0] for n in range(count)]


@pytest.mark.slow
@pytest.mark.parametrize(
    ("count", "directivity"), [(1, "omnidirectional"), (8, "omnidirectional"), (3, "file")]
)
def test_any_receivers_from_scene_to_surface(tiny_settings, tmp_path, count, directivity):
    ears = {"receivers": line(count), "directivity": directivity, "beam_radius": 0.0}
    if directivity == "file":
        known = pair()
        known = dataclasses.replace(known, gains=known.gains[:1], places=None)
        write_sofa(tmp_path / "a.sofa", known)
        ears["file"] = str(tmp_path / "a.sofa")
    settings = tiny_settings(
        ears=ears,
        fit={"epochs": 1, "steps_per_epoch": 2, "batch_poses": 2, "batch_frequencies": 2},
        data={"store": str(tmp_path / "store")},
        noise={"snr_db": 40.0},
    )
    run(settings, tmp_path / "run")
    store = EnsembleStore.open(tmp_path / "store")
    assert store.receivers == count
    heard = store.read_pose(0)
    assert (heard.max(axis=(1, 2)) > 0.0).all()
    (tmp_path / "a.sofa").unlink(missing_ok=True)  # the run has a copy
    folder = reconstruct(tmp_path / "run", accelerator="cpu")
    assert Run(tmp_path / "run").read_metrics()["cost"]["steps"] == 2
    assert len(trimesh.load(folder / "mesh.ply").faces) > 100


def test_a_fit_that_needs_too_much_memory_leaves_nothing(tiny, tmp_path, monkeypatch):
    monkeypatch.setattr(resources, "available_memory", lambda: 1_000_000)
    with pytest.raises(ResourceError, match="a step of 2 poses needs about"):
        fit(tiny(), tmp_path / "run", accelerator="cpu", workers=1)
    assert not (tmp_path / "run").exists()


def test_a_process_that_follows_does_not_wait_for_one_that_was_killed(tiny, tmp_path, monkeypatch):
    path = tmp_path / "run"
    path.mkdir()
    (path / ".lock").write_text("of a dead process")
    monkeypatch.setattr(rank_zero_only, "rank", 1)
    monkeypatch.setattr(fit_module, "PATIENCE_SECONDS", 0.2)
    monkeypatch.setattr(fit_module, "WAIT_SECONDS", 0.05)
    settings = tiny(data={"store": str(tmp_path / "none")})
    with pytest.raises(ResourceError, match="the first process of this fit does not run"):
        fit(settings, path, accelerator="cpu")


BODY = np.array([[-0.035] * 3, [0.035] * 3])
"""Around the tiny experiment's sphere, m."""


@pytest.fixture(scope="module")
def heard(echoes):
    return Echoes.open(echoes)


def copied(heard, poses, rows):
    """Return echoes of some poses of an ensemble, said to be heard at other poses."""
    arrays = np.stack([heard.spectrogram(int(row)) for row in rows])
    return Echoes.from_arrays(arrays, poses, heard.head, split=["train"] * len(rows))


@pytest.mark.parametrize("is_set", [False, True])
def test_a_sound_fit_gets_no_warning(heard, is_set):
    assert fit_warnings(heard.within(BODY) if is_set else heard, BODY, is_set=is_set) == []


@pytest.mark.parametrize(
    ("region", "message"),
    [
        (BODY + np.array([0.0, 0.0, 0.07]), "training poses hear echoes, and none from the region"),
        (BODY * 14.0, "poses lie inside the region"),
        (BODY * 4.0, "places of training poses are few for a region of 280 mm"),
        (BODY * 3.0 + np.array([0.0, 0.0, 1.5]), "no training pose hears 100 % of the region"),
    ],
)
def test_a_region_that_does_not_suit_the_echoes_is_told(heard, region, message):
    told = fit_warnings(heard.within(region), region, is_set=True)
    assert any(message in line for line in told), told


def test_repeated_poses_on_a_line_are_told(heard):
    rows = [0, 0, 0, 0, 1]
    told = fit_warnings(copied(heard, heard.poses()[rows], rows), BODY, is_set=False)
    assert told[0].startswith("only 2 of 5 training poses differ")
    assert LINE_WARNING in told


def test_poses_that_look_away_are_told(heard):
    rows = np.arange(8)
    turned = heard.rotations[rows] @ np.diag([-1.0, -1.0, 1.0])
    poses = Poses(heard.positions[rows], turned)
    (told,) = fit_warnings(copied(heard, poses, rows), BODY, is_set=False)
    assert told.startswith("training poses look away from the body")
    assert "the poses look the other way" in told


@pytest.mark.slow
def test_where_heads_look_makes_no_difference_to_omnidirectional_ones(heard):
    ears = {"directivity": "omnidirectional", "beam_radius": 0.0}
    head = Head.from_plain({**heard.head.plain(), "ears": ears})
    turned = heard.rotations @ np.diag([-1.0, -1.0, 1.0])
    arrays = np.stack([heard.spectrogram(row) for row in range(len(heard))])
    echoes = Echoes.from_arrays(arrays, Poses(heard.positions, turned), head)
    assert fit_warnings(echoes, BODY, is_set=False) == []


def test_a_body_below_its_support_is_told(heard):
    head = Head.from_plain({**heard.head.plain(), "support": {"point": [0.0, 0.0, 0.07]}})
    told = fit_warnings(Echoes(heard.store, head), BODY, is_set=False)
    assert any("from below the support" in line for line in told)


class KilledError(Exception):
    """The process is gone."""


class Killed(lightning.Callback):
    """Raises within the third epoch."""

    def on_train_batch_end(self, trainer, pl_module, *rest):
        if trainer.global_step == 10:
            raise KilledError


@pytest.fixture
def made(tiny, echoes):
    """Module and data of the tiny experiment; four steps are an epoch."""

    def make():
        settings = tiny()
        heard = Echoes(EnsembleStore.open(echoes), head_of(settings))
        module = EchoModule.for_echoes(
            heard,
            field_options=settings.field.options,
            renderer_options=settings.renderer.options,
            options=settings.fit,
        )
        return module, EchoDataModule(heard)

    return make


def trainer(folder, *callbacks, **options):
    quiet_lightning()
    return lightning.Trainer(
        accelerator="cpu",
        max_epochs=5,
        callbacks=list(callbacks),
        default_root_dir=folder,
        enable_progress_bar=False,
        enable_model_summary=False,
        logger=False,
        **options,
    )


@pytest.mark.parametrize("every", [{"every_n_epochs": 1}, {"every_n_train_steps": 3}])
def test_a_killed_fit_ends_with_the_weights_of_one_that_was_not(made, tmp_path, every):
    through, data = made()
    whole = trainer(tmp_path, enable_checkpointing=False)
    whole.fit(through, data)
    assert (whole.current_epoch, whole.global_step) == (5, 20)

    def keeper():
        return ModelCheckpoint(tmp_path, filename="kept", save_last=True, **every)

    killed = trainer(tmp_path, keeper(), Killed())
    with pytest.raises(KilledError):
        killed.fit(*made())
    resumed, data = made()
    rest = trainer(tmp_path, keeper())
    rest.fit(resumed, data, ckpt_path=tmp_path / "last.ckpt")
    assert (rest.current_epoch, rest.global_step) == (5, 20)
    for name, wanted in through.state_dict().items():
        assert torch.equal(resumed.state_dict()[name], wanted), name


def test_a_trainers_test_gives_the_numbers_of_a_prediction(run, tmp_path):
    opened = Run(run)
    predict(opened, accelerator="cpu", progress=Progress(quiet=True))
    numbers = opened.read_metrics()["prediction"]
    data = EchoDataModule(opened.echoes)
    (found,) = trainer(tmp_path, enable_checkpointing=False).test(opened.model, data, verbose=False)
    assert found["test/mae_db"] == pytest.approx(numbers["rendered_mae_db"], rel=1e-5)
    assert found["test/mae_db_active"] == pytest.approx(numbers["rendered_mae_db_active"], rel=1e-5)
