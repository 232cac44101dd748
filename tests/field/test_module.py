# SPDX-License-Identifier: MIT
import math
from types import SimpleNamespace

import lightning
import numpy as np
import pytest
import torch
from torch.utils._python_dispatch import TorchDispatchMode

from sononerf.echoes.store import EnsembleStore
from sononerf.errors import NumericalError
from sononerf.field.datamodule import EchoDataModule
from sononerf.field.grid import GridField
from sononerf.field.module import WORTH_THREADS, EchoModule, decibels
from sononerf.field.profile import ProfileRenderer
from sononerf.field.range_slices import RangeSlices
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
LOSSES = {
    "l1": (0.1 + 0.2) / 2,
    "l2": 0.5 * (0.01 + 0.04) / 2,
    "l1_4l2": (0.1 + 0.2 + 4 * (0.01 + 0.04)) / 2,
}


@pytest.mark.parametrize("loss", LOSSES)
def test_losses_by_hand(loss, monkeypatch):
    found = module(Given(PREDICTED), loss=loss)
    values = logged(found, monkeypatch)
    monkeypatch.setattr(found.renderer, "prepare", lambda *_: False)
    assert float(found.training_step(batch(MEASURED), 0).detach()) == pytest.approx(
        LOSSES[loss], rel=1e-4
    )
    assert values["train/loss"] == pytest.approx(LOSSES[loss], rel=1e-4)


def test_the_fit_may_compress_otherwise():
    """40 dB instead of 60: the floor is ten times as high, and the error a part of 40."""
    found = module(Given(PREDICTED), dynamic_range_db=40.0)

    def level(x):
        return 20 * math.log10(1 + x / 0.01)

    pairs = zip(PREDICTED.flatten().tolist(), MEASURED.flatten().tolist(), strict=True)
    expected = np.mean([abs(level(p) - level(m)) / 40 for p, m in pairs])
    assert float(found._loss(PREDICTED, MEASURED).detach()) == pytest.approx(expected, rel=1e-4)


def level_above(reference, value):
    return 20 * math.log10(1 + value / reference)


def test_the_fit_first_hears_what_is_loud(monkeypatch):
    found = module(Given(PREDICTED), early_range_db=30.0, early_share=0.75)
    assert [found.range_db(step) for step in (0, 74, 75, 100)] == [30.0, 30.0, 60.0, 60.0]
    # Never farther down than later, and from the first step where no share is early.
    assert module(Given(PREDICTED), early_range_db=90.0, early_share=1.0).range_db(5) == 60.0
    assert module(Given(PREDICTED), early_range_db=30.0, early_share=0.0).range_db(0) == 60.0
    # Of 100 steps the loss hears 30 dB below the pose's loudest, 0.999, in the 74th, and 60 dB
    # below that of all poses from the 75th.
    monkeypatch.setattr(found.renderer, "prepare", lambda *_: False)
    pairs = list(zip(PREDICTED.flatten().tolist(), MEASURED.flatten().tolist(), strict=True))
    for step, span, reference in ((74, 30, 0.999 * 10**-1.5), (75, 60, 0.001)):
        monkeypatch.setattr(type(found), "global_step", step)
        values = logged(found, monkeypatch)
        expected = np.mean(
            [abs(level_above(reference, p) - level_above(reference, m)) / span for p, m in pairs]
        )
        found.training_step(batch(MEASURED), 0)
        assert values["train/loss"] == pytest.approx(expected, rel=1e-4)
    assert expected == pytest.approx(LOSSES["l1"], rel=1e-4)


def test_what_is_silent_at_first_is_judged_by_what_is_heard_at_first():
    """20 dB above a floor 30 dB lower is 2.3 dB above the higher one."""
    quiet = torch.full((1, 1, 1, 1), 0.001 * 9)
    measured = torch.cat((torch.zeros(1, 1, 1, 1), torch.ones(1, 1, 1, 1)), dim=3)
    predicted = torch.cat((quiet, torch.ones(1, 1, 1, 1)), dim=3)
    found = module(Given(predicted), early_range_db=30.0, early_share=1.0, silent_weight=0.5)
    assert 0 < level_above(10**-1.5, 0.009) < 3
    expected = 0.5 * level_above(10**-1.5, 0.009) / 30 / 1.5
    assert float(found._loss(predicted, measured).detach()) == pytest.approx(expected, rel=1e-4)


# Three poses, both ears each: a flash, echoes 40 dB below it, and hardly anything.
POSES = torch.tensor([1.0, 0.01, 1e-4])[:, None, None, None] * torch.tensor(
    [[[1.0, 0.1], [0.02, 0.5]], [[0.3, 0.05], [0.7, 0.2]]]
)


@pytest.mark.parametrize("dynamic", [60.0, 50.0])
def test_each_pose_is_first_heard_by_its_own_loudest_echo(dynamic):
    """But no farther down than the whole fit hears."""
    found = module(
        Given(0.5 * POSES), early_range_db=30.0, early_share=1.0, dynamic_range_db=dynamic
    )
    faintest = 10 ** (-dynamic / 20)
    references = [max(loudest * 10**-1.5, faintest) for loudest in (1.0, 0.01, 1e-4)]
    assert references[1] == pytest.approx(max(0.01 * 10**-1.5, faintest))
    errors = [
        [abs(level_above(reference, 0.5 * m) - level_above(reference, m)) / 30 for m in values]
        for values, reference in zip(POSES.flatten(1).tolist(), references, strict=True)
    ]
    loss = float(found._loss(0.5 * POSES, POSES).detach())
    assert loss == pytest.approx(np.mean(errors), rel=1e-4)
    # With the flash of the first pose as the measure of all, the others would be silence.
    common = [
        [abs(level_above(10**-1.5, 0.5 * m) - level_above(10**-1.5, m)) / 30 for m in values]
        for values in POSES.flatten(1).tolist()
    ]
    assert np.mean(errors[1]) > 5 * np.mean(common[1])


def test_a_pose_first_weighs_as_much_whatever_else_is_in_the_batch():
    found = module(Given(POSES), early_range_db=30.0, early_share=1.0)
    alone = [float(found._loss(0.5 * one, one).detach()) for one in POSES.split(1)]
    assert float(found._loss(0.5 * POSES, POSES).detach()) == pytest.approx(np.mean(alone))


def test_single_slices_are_first_heard_by_the_loudest_of_all():
    """They do not tell how loud their poses are."""

    class Slices(Given):
        whole_poses = False

    found = module(Slices(0.5 * POSES), early_range_db=30.0, early_share=1.0)
    errors = [
        abs(level_above(10**-1.5, 0.5 * m) - level_above(10**-1.5, m)) / 30
        for m in POSES.flatten().tolist()
    ]
    loss = float(found._loss(0.5 * POSES, POSES).detach())
    assert loss == pytest.approx(np.mean(errors), rel=1e-4)


def test_the_field_hears_how_far_the_fit_is_before_it_is_asked(monkeypatch):
    found = module(Given(PREDICTED), total_steps=40)
    logged(found, monkeypatch)
    calls = []
    monkeypatch.setattr(found.field, "advance", lambda *given: calls.append(("advance", *given)))
    monkeypatch.setattr(
        found.renderer, "prepare", lambda *given: calls.append(("prepare", given[2]))
    )
    for step in (0, 7):
        monkeypatch.setattr(type(found), "global_step", step)
        found.training_step(batch(MEASURED), 0)
    assert calls == [("advance", 0, 40), ("prepare", 0), ("advance", 7, 40), ("prepare", 7)]


def test_the_renderer_hears_how_far_the_fit_is_before_it_prepares(monkeypatch):
    found = module(Given(PREDICTED), total_steps=40)
    logged(found, monkeypatch)
    calls = []
    for name in ("advance", "prepare", "calibrate"):
        monkeypatch.setattr(
            found.renderer, name, lambda *given, n=name: calls.append((n, given[-2:])) or True
        )
    monkeypatch.setattr(type(found), "global_step", 7)
    found.training_step(batch(MEASURED), 0)
    assert [name for name, _ in calls] == ["advance", "prepare", "calibrate"]
    assert calls[0][1] == (7, 40)


def test_silent_cells_may_weigh_less():
    """A cell is silent where both stay below 3 dB; the weights are a mean's."""
    level = 0.001 * (10 ** (torch.tensor([[0.0, 0.0, 6.0, 60.0], [2.0, 6.0, 0.0, 48.0]]) / 20) - 1)
    measured, predicted = level.reshape(2, 1, 1, 1, 4)
    found = module(Given(predicted), silent_weight=0.5)
    expected = (0.5 * 2 + 6 + 6 + 12) / 60 / 3.5
    assert float(found._loss(predicted, measured).detach()) == pytest.approx(expected, rel=1e-4)
    plain = module(Given(predicted))
    assert float(plain._loss(predicted, measured).detach()) == pytest.approx(26 / 60 / 4, rel=1e-4)


def test_the_rate_cools_in_the_second_half():
    found = module(Given(PREDICTED), total_steps=100, final_rate_factor=0.01)
    rates = [found._rate(step) for step in (0, 30, 50, 75, 100)]
    assert rates == pytest.approx([1, 1, 1, 0.1, 0.01])


def test_the_rate_falls_in_stairs_of_epochs():
    found = module(Given(PREDICTED), schedule="staircase", staircase_factor=0.5, staircase_epochs=2)
    # Ten steps an epoch, two epochs a stair.
    assert [found._rate(step) for step in (0, 19, 20, 39, 40)] == [1, 1, 0.5, 0.5, 0.25]


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


class Asked(TorchDispatchMode):
    """Notes what a GPU could answer only once all that was asked of it before is done."""

    WAITS = (
        torch.ops.aten._local_scalar_dense,
        torch.ops.aten.nonzero,
        torch.ops.aten.equal,
        torch.ops.aten.masked_select,
        torch.ops.aten.unique_dim,
    )

    def __init__(self):
        super().__init__()
        self.found = []

    def __torch_dispatch__(self, func, types, args=(), kwargs=None):
        masks = args[1] if func.overloadpacket is torch.ops.aten.index else ()
        if func.overloadpacket in self.WAITS or any(
            m is not None and m.dtype == torch.bool for m in masks
        ):
            self.found.append(str(func))
        return func(*args, **(kwargs or {}))


def test_a_step_on_a_gpu_waits_for_no_number(monkeypatch):
    field = GridField(REGION, FREQUENCY, spacing=0.01, levels=2)
    found = module(ProfileRenderer(REGION, LISTENER), field, total_steps=4)
    optimizer = found.configure_optimizers()["optimizer"]
    monkeypatch.setattr(found, "_is_logged", lambda step: False)
    monkeypatch.setattr(torch.Tensor, "tolist", lambda self: [x.item() for x in self])
    generator = torch.Generator().manual_seed(0)
    given = batch(torch.rand(2, 2, 150, 3, generator=generator))
    given = given._replace(position=torch.tensor([[0.0, 0.0, 0.25], [0.0, 0.24, 0.0]]))

    def asked(step):
        monkeypatch.setattr(EchoModule, "global_step", step)
        with Asked() as watched:
            optimizer.zero_grad()
            found.training_step(given, step).backward()
            found.configure_gradient_clipping(optimizer, 1.0)
            optimizer.step()
        return watched.found

    assert asked(0)  # the lattice is laid, and the first of a step's answers are kept
    asked(3)  # the coherent one turns
    assert asked(1)  # a CPU is asked
    heard = found(given)
    monkeypatch.setattr(Renderer, "may_ask", False)
    torch.testing.assert_close(found(given), heard)
    assert asked(1) == []


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


def test_all_devices_begin_with_one_gain(monkeypatch):
    """Each is calibrated on its own share of the batch; nothing later would bring them together."""
    found = module(Given(PREDICTED))
    logged(found, monkeypatch)
    other = 3.0  # the other device's gain and values

    def reduce(mine, reduce_op):
        assert reduce_op == "mean"
        return (mine + other) / 2

    strategy = SimpleNamespace(reduce=reduce)
    monkeypatch.setattr(type(found), "trainer", SimpleNamespace(strategy=strategy))
    monkeypatch.setattr(type(found), "global_step", 0)
    monkeypatch.setattr(torch.distributed, "is_initialized", lambda: True)
    found.training_step(batch(MEASURED), 0)
    ratio = MEASURED.square().sum() / PREDICTED.square().sum()
    expected = (0.5 * float(ratio.log()) + other) / 2
    assert float(found.renderer.log_gain.detach()) == pytest.approx(expected, rel=1e-5)
    torch.testing.assert_close(found.renderer.values.detach(), (PREDICTED + other) / 2)
    # Between two calibrations, and with one device, everyone keeps what it has.
    monkeypatch.setattr(found.renderer, "prepare", lambda *_: False)
    found.training_step(batch(MEASURED), 0)
    torch.testing.assert_close(found.renderer.values.detach(), (PREDICTED + other) / 2)


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
        poses_positions=positions,
        poses_rotations=rotations,
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


@pytest.mark.parametrize(
    ("step", "read"), [(0, False), (3, False), (4, True), (10, False), (11, True), (12, True)]
)
def test_only_steps_that_somebody_reads_are_logged(monkeypatch, step, read):
    """The logger every fifth, a preview each twelfth, and the last."""
    found = module(Given(MEASURED), total_steps=13)
    found.steps_per_epoch = 12
    values = logged(found, monkeypatch)
    monkeypatch.setattr(type(found), "global_step", step)
    found._trainer = SimpleNamespace(log_every_n_steps=5)
    found.training_step(batch(MEASURED), 0)
    assert values.keys() == ({"train/loss"} if read else set())


@pytest.fixture
def two_threads():
    before = torch.get_num_threads()
    torch.set_num_threads(2)
    yield
    torch.set_num_threads(before)


@pytest.mark.parametrize(
    ("places", "poses", "costly", "expected"),
    [
        (WORTH_THREADS // 4 - 1, 4, False, 1),
        (WORTH_THREADS // 4, 4, False, 2),
        (100, 4, True, 2),  # a network
        (None, 4, False, 2),  # not known: as torch would
    ],
)
def test_small_steps_take_one_thread(two_threads, monkeypatch, places, poses, costly, expected):
    found = module(Given(MEASURED))
    monkeypatch.setattr(Given, "places_per_pose", places)
    monkeypatch.setattr(type(found.field), "costly", costly)
    found.setup("fit")
    found.on_train_batch_start(SimpleNamespace(pose=range(poses)), 0)
    assert torch.get_num_threads() == expected
    found.teardown("fit")
    assert torch.get_num_threads() == 2
