# SPDX-License-Identifier: MIT
"""A Trainer of the user's own: epochs end, a killed fit goes on, and a test gives our numbers."""

from __future__ import annotations

import lightning
import pytest
import torch
from lightning.pytorch.callbacks import ModelCheckpoint

from sononerf.echoes.echoes import Echoes
from sononerf.echoes.store import EnsembleStore
from sononerf.field.datamodule import EchoDataModule
from sononerf.field.fitting import quiet_lightning
from sononerf.field.module import EchoModule
from sononerf.progress import Progress
from sononerf.run.build import head_of
from sononerf.run.predict import predict
from sononerf.run.run import Run


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
