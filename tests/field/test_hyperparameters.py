# SPDX-License-Identifier: MIT
"""A module is made again from its checkpoint alone, and refuses what it cannot be made of."""

from __future__ import annotations

import pickle

import lightning
import numpy as np
import pytest
import torch

from sononerf.echoes.echoes import Echoes
from sononerf.errors import IncompatibleError, InputError, SettingsError
from sononerf.field.datamodule import EchoDataModule
from sononerf.field.field import Field
from sononerf.field.fields import GridField
from sononerf.field.fitting import fit, quiet_lightning
from sononerf.field.module import EchoModule
from sononerf.geometry.poses import Poses
from sononerf.head.head import Head

HEAD = Head(spectrogram={"range_min": 0.3, "range_max": 0.36})
BOX = ((-0.02,) * 3, (0.02,) * 3)
SMALL = {"field_options": {"finest": 0.01, "levels": 2}, "renderer_options": {"start": 2000}}


@pytest.fixture(scope="module")
def echoes():
    """Of a wall of noise at one range: enough to step through."""
    poses = Poses.sphere(12, radius=0.33)
    heard = np.full((12, 2, len(HEAD.range), len(HEAD.frequency)), 1e-4)
    heard[:, :, 10:14] = np.random.default_rng(0).uniform(0.5, 1.0, (12, 2, 4, heard.shape[-1]))
    return Echoes.from_arrays(heard, poses, HEAD, split=["train"] * 8 + ["val"] * 2 + ["test"] * 2)


def trained(echoes, folder, **options):
    quiet_lightning()
    model = EchoModule.for_echoes(echoes, region=BOX, options=options, **SMALL)
    trainer = lightning.Trainer(
        max_steps=2, default_root_dir=folder, logger=False, enable_progress_bar=False,
        enable_model_summary=False, enable_checkpointing=False,
    )  # fmt: skip
    trainer.fit(model, EchoDataModule(echoes))
    trainer.save_checkpoint(folder / "model.ckpt")
    return model


def test_a_module_is_made_again_from_its_checkpoint(echoes, tmp_path):
    model = trained(echoes, tmp_path, loss="l2", batch_poses=2, seed=3)
    again = EchoModule.load_from_checkpoint(tmp_path / "model.ckpt")
    assert again.options == model.options
    assert (again.options.loss, again.reference) == ("l2", echoes.reference)
    assert again.head.plain() == HEAD.plain()
    for name, values in model.state_dict().items():
        assert torch.equal(again.state_dict()[name], values), name
    plain = torch.load(tmp_path / "model.ckpt", weights_only=True)["hyper_parameters"]
    assert (plain["field"], plain["options"]["seed"]) == ("grid", 3)


def test_a_module_can_be_pickled_for_strategies_that_start_processes(echoes):
    model = EchoModule.for_echoes(echoes, region=BOX, **SMALL)
    again = pickle.loads(pickle.dumps(model))
    places = torch.zeros(1, 3)
    assert torch.equal(again.possible(places, 0.01), model.possible(places, 0.01))


class Other(lightning.LightningModule):
    """A module of somebody else's."""

    def __init__(self):
        super().__init__()
        self.layer = torch.nn.Linear(1, 1)


class Trap:
    """Runs code where it is unpickled without care."""

    def __reduce__(self):
        return print, ("code of the file runs",)


def test_what_is_no_checkpoint_of_ours_is_refused(echoes, tmp_path, capsys):
    plain = {"state_dict": Other().state_dict(), "pytorch-lightning_version": "2.6.0"}
    torch.save({**plain, "hyper_parameters": {"width": 3}}, tmp_path / "other.ckpt")
    torch.save({**plain, "hyper_parameters": {"trap": Trap()}}, tmp_path / "trap.ckpt")
    (tmp_path / "junk.ckpt").write_bytes(b"junk")
    for name, error, message in (
        ("other.ckpt", IncompatibleError, "is no checkpoint of this EchoModule"),
        ("trap.ckpt", InputError, "no checkpoint of plain data"),
        ("junk.ckpt", InputError, "start the fit again"),
        ("missing.ckpt", InputError, "start the fit again"),
    ):
        with pytest.raises(error, match=message):
            EchoModule.load_from_checkpoint(tmp_path / name, weights_only=False)
    assert "code of the file runs" not in capsys.readouterr().out
    made = EchoModule.for_echoes(echoes, lambda r, f: GridField(r, f, finest=0.01), region=BOX)
    trainer = lightning.Trainer(
        max_steps=1, logger=False, enable_progress_bar=False, enable_model_summary=False,
        enable_checkpointing=False, default_root_dir=tmp_path,
    )  # fmt: skip
    trainer.fit(made, EchoDataModule(echoes))
    trainer.save_checkpoint(tmp_path / "mine.ckpt")
    with pytest.raises(IncompatibleError, match="has to be given again"):
        EchoModule.load_from_checkpoint(tmp_path / "mine.ckpt")


def test_data_follow_the_options_of_the_module(echoes, tmp_path):
    model = trained(echoes, tmp_path, batch_poses=4, steps_per_epoch=7)
    data = model.trainer.datamodule
    assert (data.options, data.whole_poses) == (model.options, True)
    assert data.steps_per_epoch == 2  # all that the trainer takes
    assert EchoDataModule(echoes, {"steps_per_epoch": 7}).steps_per_epoch == 7


def test_a_factory_and_an_object_do_as_well(echoes, tmp_path):
    made = []

    def mine(region, frequency, *, spacing: float = 0.01) -> Field:
        made.append(spacing)
        return GridField(region, frequency, finest=spacing, levels=1)

    model = EchoModule.for_echoes(echoes, mine, region=BOX, field_options={"spacing": 0.02})
    assert made == [0.02]
    assert "field" not in model.hparams
    same = EchoModule.for_echoes(echoes, model.field)
    assert same.field is model.field
    np.testing.assert_array_equal(same.renderer.region, model.field.region)


def test_random_numbers_of_the_caller_are_left_alone(echoes, tmp_path):
    torch.manual_seed(7)
    wanted = torch.rand(3)
    torch.manual_seed(7)
    trained(echoes, tmp_path)
    assert torch.equal(torch.rand(3), wanted)


@pytest.mark.parametrize("field", ["grid", "fourier"])
def test_half_precision_leaves_ranges_alone(echoes, tmp_path, field):
    quiet_lightning()
    options = SMALL if field == "grid" else {"field_options": {"width": 16, "octaves": 4}}
    model = EchoModule.for_echoes(echoes, field, region=BOX, **options)
    seen = []
    real = model.renderer.forward

    def forward(given, position, rotation, rows, bins=None):
        seen.append(torch.is_autocast_enabled("cpu") or position.dtype != torch.float32)
        return real(given, position, rotation, rows, bins)

    model.renderer.forward = forward
    lightning.Trainer(
        max_steps=2, precision="bf16-mixed", default_root_dir=tmp_path, logger=False,
        enable_progress_bar=False, enable_model_summary=False, enable_checkpointing=False,
    ).fit(model, EchoDataModule(echoes))  # fmt: skip
    assert len(seen) > 2
    assert not any(seen)
    assert model.field.half_precision
    assert all(p.dtype == torch.float32 and p.isfinite().all() for p in model.parameters())


def test_a_fit_without_more_words(echoes):
    model = fit(echoes, EchoModule.for_echoes(
        echoes, region=BOX, options={"epochs": 1, "steps_per_epoch": 2}, **SMALL
    ))  # fmt: skip
    assert model.global_step == 2
    with pytest.raises(SettingsError, match="the model has its own"):
        fit(echoes, model, options={"epochs": 2})


@pytest.mark.parametrize(
    ("changes", "error", "message"),
    [
        ({"field": "gird"}, SettingsError, "unknown field 'gird'; did you mean grid"),
        ({"field": 3}, InputError, "field is a int, expected the name of a plugin, a factory"),
        ({"field": lambda region, frequency: 3}, InputError, "makes a int, expected a sononerf F"),
        ({"options": {"epoch": 3}}, SettingsError, r"fit\.epoch: unknown key; did you mean epochs"),
        ({"options": 3}, SettingsError, "fit: found int, expected keys and values"),
        ({"region": ((0, 0, 0), (0, 1, 1))}, SettingsError, "region: found .*lower and upper"),
        ({"region": None}, SettingsError, "region: missing"),
        ({"head": None}, SettingsError, "head: missing"),
    ],
)
def test_what_cannot_be_made_is_refused(changes, error, message):
    given = {"field": "grid", "renderer": "profile", "region": BOX, "head": HEAD, "reference": 1.0}
    with pytest.raises(error, match=message):
        EchoModule(**{**given, **changes})
