# SPDX-License-Identifier: MIT
"""A training of eight steps in two epochs, for callbacks to hang on."""

from __future__ import annotations

from types import SimpleNamespace

import lightning
import pytest

from sononerf.callbacks import RunLogger
from sononerf.echoes.echoes import Echoes
from sononerf.echoes.store import EnsembleStore
from sononerf.field.checkpoint_io import DurableCheckpointIO
from sononerf.field.datamodule import EchoDataModule
from sononerf.field.fitting import quiet_lightning
from sononerf.field.module import EchoModule
from sononerf.run.simulate import head_of, simulate
from sononerf.settings.loading import validate_settings

SETTINGS = {
    "scene": {"name": "sphere", "options": {"radius": 0.02}},
    "poses": {"count": 8, "validation": 2, "heldout": 0},
    "simulation": {"rays": 500, "sources": 60},
    "spectrogram": {"range_min": 0.34, "range_max": 0.45},
    "field": {"options": {"finest": 0.01, "levels": 2}},
    "renderer": {"options": {"start": 2000}},
    "fit": {"batch_poses": 2, "batch_frequencies": 2},
}
PER_EPOCH, STEPS = 4, 8


@pytest.fixture(scope="session")
def ensemble(tmp_path_factory):
    settings = validate_settings(SETTINGS, "callbacks")
    path = tmp_path_factory.mktemp("callbacks") / "store"
    return settings, simulate(settings, output=path, workers=1).path


@pytest.fixture
def training(ensemble, tmp_path):
    """Make module, data and a trainer with callbacks; ``train`` runs them."""
    settings, path = ensemble

    def make(*callbacks, validation=True, sanity=0, logger=False, steps=STEPS):
        quiet_lightning()
        echoes = Echoes(EnsembleStore.open(path), head_of(settings))
        options = settings.fit.model_copy(update={"steps_per_epoch": PER_EPOCH})
        module = EchoModule.for_echoes(
            echoes,
            field_options=settings.field.options,
            renderer_options=settings.renderer.options,
            options=options,
        )
        data = EchoDataModule(echoes)
        trainer = lightning.Trainer(
            accelerator="cpu",
            max_epochs=steps // PER_EPOCH,
            limit_val_batches=1.0 if validation else 0,
            num_sanity_val_steps=sanity,
            logger=RunLogger(tmp_path) if logger else False,
            callbacks=list(callbacks),
            plugins=[DurableCheckpointIO()],
            enable_checkpointing=False,
            enable_progress_bar=False,
            enable_model_summary=False,
            log_every_n_steps=1,
            default_root_dir=tmp_path,
        )

        def train(checkpoint=None):
            trainer.fit(module, data, ckpt_path=checkpoint, weights_only=True)

        return SimpleNamespace(module=module, data=data, trainer=trainer, train=train)

    return make
