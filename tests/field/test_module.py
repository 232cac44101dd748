# SPDX-License-Identifier: MIT
import hashlib
import json
import math
import resource
from types import SimpleNamespace

import lightning
import numpy as np
import pytest
import torch

from sononerf.echoes.store import EnsembleStore
from sononerf.errors import IncompatibleError, InputError, NumericalError, StorageError
from sononerf.field.checkpoint_io import (
    DESCRIPTION_NAME,
    WEIGHTS_NAME,
    DurableCheckpointIO,
    load_weights,
    model_checksum,
    save_weights,
)
from sononerf.field.datamodule import EchoDataModule, RangeSlices
from sononerf.field.fields import GridField
from sononerf.field.module import EchoModule, decibels
from sononerf.field.profile import ProfileRenderer
from sononerf.field.renderer import Renderer, ShellRenderer
from sononerf.geometry.directions import fibonacci_sphere
from sononerf.geometry.poses import look_at

REGION = torch.tensor([[-0.02] * 3, [0.02] * 3])
FREQUENCY = torch.tensor([40e3, 60e3, 80e3])
STEP = 4 * 343 / 1e6 / 2
LISTENER = SimpleNamespace(
    frequency=FREQUENCY,
    range=0.2 + torch.arange(150) * STEP,
    window=torch.hamming_window(64, periodic=False).expand(3, -1),
    sampling_rate=1e6,
    speed_of_sound=343.0,
    row_absorption=torch.tensor([0.1, 0.2, 0.3]),
    row_gains=SimpleNamespace(beam=torch.ones(3, 5, 9), ears=torch.ones(2, 3, 5, 9)),
    lag=None,
    plane=None,
    resolution=34 * STEP / 4,
    emitter=torch.zeros(3),
    receivers=torch.tensor([[-0.01, 0.01, 0.0], [-0.01, -0.01, 0.0]]),
)


class Given(Renderer):
    """Renders a parameter, whatever the field and the pose."""

    def __init__(self, values):
        super().__init__(REGION, LISTENER)
        self.values = torch.nn.Parameter(values.clone())

    def forward(self, field, position, rotation, rows, bins=None):
        return self.values


def module(renderer, field=None, *, total_steps=100, **options):
    field = field or GridField(REGION, FREQUENCY, spacing=0.01, levels=1)
    given = {"reference": 0.001, "dynamic_range_db": 60.0, "possible": None}
    given |= {key: options.pop(key) for key in given if key in options}
    plain = {"learning_rate": 0.1, "early_share": 0.0, **options}
    found = EchoModule(field, renderer, options=plain, **given)
    found.total_steps, found.steps_per_epoch = total_steps, 10
    return found


def batch(spectrum):
    count = len(spectrum)
    rows = torch.arange(spectrum.shape[2]).expand(count, -1)
    bins = torch.arange(spectrum.shape[3])
    pose = torch.arange(count)
    return RangeSlices(
        pose, torch.zeros(count, 3), torch.eye(3).expand(count, 3, 3), rows, bins, spectrum
    )


def logged(found, monkeypatch):
    values = {}
    monkeypatch.setattr(
        found,
        "log",
        lambda name, value, **_: values.update({name: float(torch.as_tensor(value).detach())}),
    )
    return values


def test_decibels_have_a_soft_floor():
    found = decibels(torch.tensor([0.0, 0.001, 0.999]), 0.001)
    np.testing.assert_allclose(found, [0.0, 20 * math.log10(2), 60.0], atol=1e-4)


# Measured 0 dB and 60 dB, predicted 6 dB and 48 dB: errors of 0.1 and -0.2 of the full 60 dB.
MEASURED = torch.tensor([0.0, 10**3 - 1]).mul(0.001).reshape(1, 1, 1, 2)
PREDICTED = torch.tensor([10**0.3 - 1, 10**2.4 - 1]).mul(0.001).reshape(1, 1, 1, 2)


# Three poses, both ears each: a flash, echoes 40 dB below it, and hardly anything.
def test_the_schedule_reaches_the_optimizer():
    found = module(Given(PREDICTED), total_steps=4, final_rate_factor=0.01)
    configured = found.configure_optimizers()
    optimizer, scheduler = configured["optimizer"], configured["lr_scheduler"]["scheduler"]
    assert configured["lr_scheduler"]["interval"] == "step"
    rates = []
    for _ in range(5):
        rates.append(optimizer.param_groups[0]["lr"])
        optimizer.step()
        scheduler.step()
    assert rates == pytest.approx([0.1, 0.1, 0.1, 0.01, 0.001])
    assert sum(len(g["params"]) for g in optimizer.param_groups) == len(list(found.parameters()))


@pytest.mark.parametrize("value", [math.nan, math.inf])
def test_a_gradient_that_is_no_number_stops_the_fit_by_name(value):
    found = module(Given(PREDICTED))
    found.renderer.values.grad = torch.ones_like(PREDICTED)
    found.field.spectrum.grad = torch.zeros(3)
    found.configure_gradient_clipping(None)
    found.field.spectrum.grad[1] = value
    with pytest.raises(
        NumericalError, match=r"gradient of field\.spectrum is not finite at step 0"
    ):
        found.configure_gradient_clipping(None)
    found.field.spectrum.grad[1] = 0.0
    found.renderer.values.grad[0, 0, 0, 1] = value
    with pytest.raises(NumericalError, match=r"gradient of renderer\.values"):
        found.configure_gradient_clipping(None, 1.0)


def test_a_checkpoint_of_what_is_no_number_is_refused():
    found = module(Given(PREDICTED))
    found.on_save_checkpoint({})
    with torch.no_grad():
        found.field.spectrum[1] = math.nan
    with pytest.raises(NumericalError, match=r"^field\.spectrum is not finite at step 0"):
        found.on_save_checkpoint({})


def test_the_gradient_is_clipped_by_its_norm_over_all_parameters():
    found = module(Given(PREDICTED))
    field, renderer = found.field.spectrum, found.renderer.values
    field.grad = torch.zeros(3)
    renderer.grad = torch.zeros_like(PREDICTED)
    field.grad[0], renderer.grad[0, 0, 0, 0] = 3.0, 4.0
    found.configure_gradient_clipping(None)  # none is set
    assert (field.grad[0], renderer.grad[0, 0, 0, 0]) == (3.0, 4.0)
    found.configure_gradient_clipping(None, 2.5)
    assert float(field.grad[0]) == pytest.approx(1.5, rel=1e-5)
    assert float(renderer.grad[0, 0, 0, 0]) == pytest.approx(2.0, rel=1e-5)
    found.configure_gradient_clipping(None, 10.0)  # it is less already
    assert float(field.grad[0]) == pytest.approx(1.5, rel=1e-5)


def test_validation_is_in_the_decibels_of_every_report(monkeypatch):
    """Errors 6 and -12 dB, both active; then 2 dB in silence and 3 dB, all over two batches."""
    found = module(Given(PREDICTED), dynamic_range_db=30.0)
    values = logged(found, monkeypatch)
    found.validation_step(batch(MEASURED), 0)
    levels = 0.001 * (10 ** (torch.tensor([[0.0, 0.0], [2.0, 3.01]]) / 20) - 1)
    found.renderer.values.data = levels[1].reshape(1, 1, 1, 2)
    found.validation_step(batch(levels[0].reshape(1, 1, 1, 2)), 1)
    found.on_validation_epoch_end()
    assert values["val/mae_db"] == pytest.approx((6 + 12 + 2 + 3.01) / 4, rel=1e-4)
    assert values["val/mae_db_active"] == pytest.approx((6 + 12 + 3.01) / 3, rel=1e-4)
    # The next epoch starts anew, and where nothing is active there is no such figure.
    values.clear()
    found.renderer.values.data = levels[1, :1].reshape(1, 1, 1, 1)
    found.validation_step(batch(levels[0, :1].reshape(1, 1, 1, 1)), 0)
    found.on_validation_epoch_end()
    assert values == {"val/mae_db": pytest.approx(2, rel=1e-4)}


def test_the_first_step_sets_the_gain(monkeypatch):
    asked = []

    class Gained(Given):
        def forward(self, *given):
            return self.values * self.log_gain.exp()

        def prepare(self, field, possible, step):
            asked.append((possible, step))
            return True

    possible = object()
    found = module(Gained(torch.full((1, 2, 3, 2), 0.02)), possible=possible)
    logged(found, monkeypatch)
    loss = found.training_step(batch(torch.full((1, 2, 3, 2), 0.5)), 0)
    assert asked == [(possible, 0)]
    assert float(loss.detach()) == pytest.approx(0, abs=1e-6)
    assert float(found.renderer.log_gain.detach().exp()) == pytest.approx(25)
    torch.testing.assert_close(
        found.predict_step(batch(torch.zeros(1, 2, 3, 2)), 0), found(batch(torch.zeros(1, 2, 3, 2)))
    )


@pytest.fixture(scope="module")
def store(tmp_path_factory):
    """Echoes of a known field: three places of a grid, heard from 12 poses."""
    field = GridField(REGION, FREQUENCY, spacing=0.01, levels=1)
    with torch.no_grad():
        field.grids[0][:, 0] = -10.0
        for x, y, z in ((1, 1, 1), (3, 2, 1), (2, 3, 4)):
            field.grids[0][0, 0, z, y, x] = 0.0
    renderer = ProfileRenderer(REGION, LISTENER)
    renderer.prepare(field, None, 0)
    positions = 0.24 * fibonacci_sphere(12)
    rotations = look_at(positions, np.zeros(3))
    rows = torch.arange(150).expand(12, -1)
    with torch.no_grad():
        heard = renderer(
            field, torch.tensor(positions).float(), torch.tensor(rotations).float(), rows
        )
    store = EnsembleStore.create(
        tmp_path_factory.mktemp("data") / "store",
        positions=positions,
        rotations=rotations,
        split=np.arange(12) % 6 == 5,
        range=LISTENER.range.numpy(),
        frequency=FREQUENCY.numpy(),
        attributes={"echo_hash": "a", "reference": float(heard.max()) / 1000},
    )
    for index, values in enumerate(heard.numpy()):
        store.write_pose(index, values)
    return store


def fit(store, renderer, path, steps):
    torch.manual_seed(0)
    field = GridField(REGION, FREQUENCY, spacing=0.01, levels=1)
    found = module(renderer, field, reference=store.attributes["reference"], learning_rate=0.3)
    options = {"batch_poses": 4, "batch_slices": 200, "batch_frequencies": "all"}
    heard = SimpleNamespace(store=store, reference=store.attributes["reference"])
    data = EchoDataModule(heard, {**options, "steps_per_epoch": steps})
    losses = []

    class Losses(lightning.Callback):
        def on_train_batch_end(self, trainer, pl_module, outputs, *_):
            losses.append(float(outputs["loss"]))

    trainer = lightning.Trainer(
        accelerator="cpu", max_epochs=1, logger=False, num_sanity_val_steps=0,
        enable_checkpointing=False, enable_progress_bar=False, enable_model_summary=False,
        use_distributed_sampler=False, default_root_dir=path, callbacks=[Losses()],
    )  # fmt: skip
    trainer.fit(found, data)
    return losses, {k: float(v) for k, v in trainer.callback_metrics.items()}, found


def test_training_lowers_the_loss_and_repeats(store, tmp_path):
    losses, metrics, _ = fit(store, ProfileRenderer(REGION, LISTENER), tmp_path, 40)
    assert len(losses) == 40
    assert np.mean(losses[-3:]) < 0.3 * losses[0]
    assert metrics["val/mae_db"] < 0.3 * 60 * losses[0]
    again, _, _ = fit(store, ProfileRenderer(REGION, LISTENER), tmp_path, 40)
    assert again == losses


def test_training_on_single_slices_lowers_the_loss(store, tmp_path):
    losses, _, found = fit(store, ShellRenderer(REGION, LISTENER, directions=200), tmp_path, 30)
    assert np.mean(losses[-3:]) < 0.8 * losses[0]
    assert all(p.isfinite().all() for p in found.parameters())


STATE = {"grid": torch.arange(6.0).reshape(2, 3).T, "bias": torch.ones(2, dtype=torch.complex64)}


@pytest.fixture
def folder(tmp_path):
    save_weights(tmp_path, STATE, {"field": {"kind": "grid"}})
    return tmp_path


def test_round_trip(folder):
    assert (
        model_checksum(folder) == hashlib.sha256((folder / WEIGHTS_NAME).read_bytes()).hexdigest()
    )
    state, description = load_weights(folder)
    assert state.keys() == STATE.keys()
    for name, tensor in STATE.items():
        assert torch.equal(state[name], tensor)
    assert description["field"] == {"kind": "grid"}
    assert description["schema_version"] == 1


def test_same_weights_same_bytes(folder, tmp_path_factory):
    other = tmp_path_factory.mktemp("other")
    save_weights(other, STATE, {"field": {"kind": "grid"}})
    for name in (WEIGHTS_NAME, DESCRIPTION_NAME):
        assert (folder / name).read_bytes() == (other / name).read_bytes()


def test_every_flipped_byte_is_refused(folder):
    path = folder / WEIGHTS_NAME
    whole = path.read_bytes()
    for offset in range(0, len(whole), 7):
        path.write_bytes(whole[:offset] + bytes([whole[offset] ^ 1]) + whole[offset + 1 :])
        with pytest.raises(InputError, match="damaged"):
            load_weights(folder)


def test_missing_files_are_named(folder):
    (folder / WEIGHTS_NAME).unlink()
    with pytest.raises(InputError, match=WEIGHTS_NAME):
        load_weights(folder)
    (folder / DESCRIPTION_NAME).unlink()
    with pytest.raises(InputError, match=DESCRIPTION_NAME):
        load_weights(folder)


@pytest.mark.parametrize(
    ("version", "error"), [(2, IncompatibleError), (0, InputError), ("1", InputError)]
)
def test_other_schema_versions_are_refused(folder, version, error):
    path = folder / DESCRIPTION_NAME
    path.write_text(json.dumps({**json.loads(path.read_text()), "schema_version": version}))
    with pytest.raises(error, match="schema_version"):
        load_weights(folder)


@pytest.fixture
def path(tmp_path):
    io = DurableCheckpointIO()
    for step in range(3):
        io.save_checkpoint({"step": step, "w": torch.full((100,), float(step))}, tmp_path / "c")
    return tmp_path / "c"


@pytest.mark.parametrize("content", [b"", b"PK", b"no archive"])
def test_a_damaged_one_is_one_clear_line(path, content):
    path.write_bytes(content)
    with pytest.raises(InputError, match="start the fit again with --overwrite") as caught:
        DurableCheckpointIO().load_checkpoint(path)
    assert "\n" not in str(caught.value)


def test_a_full_disk_is_a_storage_error_and_keeps_the_old_one(path):
    soft, hard = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (20_000, hard))
    try:
        with pytest.raises(StorageError, match="size limit"):
            DurableCheckpointIO().save_checkpoint({"w": torch.ones(100_000)}, path)
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, (soft, hard))
    assert DurableCheckpointIO().load_checkpoint(path)["step"] == 2
    assert [p.name for p in path.parent.iterdir()] == ["c"]


def test_remove_leaves_nothing(path):
    DurableCheckpointIO().remove_checkpoint(path)
    assert list(path.parent.iterdir()) == []


def test_nan_in_weights_is_refused_with_their_name(path):
    state = {"field.table": torch.tensor([1.0, math.nan]), "hull.first": torch.tensor([-math.inf])}
    DurableCheckpointIO().save_checkpoint({"state_dict": state}, path)
    with pytest.raises(InputError, match=r"field\.table holds NaN; repeat the fit"):
        DurableCheckpointIO().load_checkpoint(path)
    save_weights(path.parent, state, {"echo_hash": "x"})
    with pytest.raises(InputError, match=r"model\.safetensors: field\.table holds NaN"):
        load_weights(path.parent)
