# SPDX-License-Identifier: MIT
"""What callbacks share: epochs counted from the step, the fit's progress, its number of threads."""

from __future__ import annotations

from typing import Any

import lightning
import torch

from sononerf.field.module import EchoModule
from sononerf.progress import Task


def echo_module(module: lightning.LightningModule) -> EchoModule:
    """Return the module that the callbacks here are made for.

    Raises:
        TypeError: If it is another one.
    """
    if not isinstance(module, EchoModule):
        raise TypeError(f"{type(module).__name__} is no EchoModule")
    return module


class EpochCallback(lightning.Callback):
    """Calls :meth:`on_epoch` once after every epoch, after its validation where there is one.

    Lightning's own epochs count wrongly after a second resume at an epoch's boundary.
    """

    def on_epoch(self, trainer: lightning.Trainer, module: EchoModule, epoch: int) -> None:
        """Do what is done each epoch; ``epoch`` counts from 1."""
        raise NotImplementedError

    @staticmethod
    def _boundary(module: EchoModule) -> bool:
        step = module.global_step
        return step > 0 and (step % module.steps_per_epoch == 0)

    def on_validation_end(
        self, trainer: lightning.Trainer, pl_module: lightning.LightningModule
    ) -> None:
        """After the epoch's validation."""
        module = echo_module(pl_module)
        if not trainer.sanity_checking and self._boundary(module):
            self.on_epoch(trainer, module, module.epoch_done)

    def on_train_batch_end(
        self,
        trainer: lightning.Trainer,
        pl_module: lightning.LightningModule,
        outputs: Any,
        batch: Any,
        batch_idx: int,
    ) -> None:
        """After the epoch's last step, where no validation follows."""
        del outputs, batch, batch_idx
        module = echo_module(pl_module)
        if self._boundary(module) and not trainer.enable_validation:
            self.on_epoch(trainer, module, module.epoch_done)


class ProgressCallback(lightning.Callback):
    """Moves a bar with every step.

    Args:
        task: One count per step.
    """

    def __init__(self, task: Task) -> None:
        self.task = task

    def on_train_start(
        self, trainer: lightning.Trainer, pl_module: lightning.LightningModule
    ) -> None:
        """Start where an interrupted fit stopped."""
        del pl_module
        self.task.advance(trainer.global_step)

    def on_train_batch_end(
        self,
        trainer: lightning.Trainer,
        pl_module: lightning.LightningModule,
        outputs: Any,
        batch: Any,
        batch_idx: int,
    ) -> None:
        """Count a step; the error on the validation poses stands behind the bar."""
        del outputs, batch, batch_idx
        module = echo_module(pl_module)
        epochs = -(-module.total_steps // module.steps_per_epoch)
        epoch = min(module.epoch_done + 1, epochs)
        note = f"epoch {epoch} of {epochs}"
        error = trainer.callback_metrics.get("val/mae_db")
        if error is not None:
            note += f", validation {float(error):.2f} dB"
        self.task.advance(note=note)


WORTH_THREADS = 40_000
"""Places per step below which threads wait for one another longer than they compute.

Measured on two cores: with 12,000 places two threads take three quarters of the time of one on an
idle machine, and two and a half times as long as one where something else runs beside. That is of
lobes; a network computes so much for a place that threads never wait."""


class ThreadsCallback(lightning.Callback):
    """Sets torch's threads before each step; a function of the step's state alone."""

    def __init__(self) -> None:
        self.most = torch.get_num_threads()

    def on_train_batch_start(
        self,
        trainer: lightning.Trainer,
        pl_module: lightning.LightningModule,
        batch: Any,
        batch_idx: int,
    ) -> None:
        """Choose for this step."""
        del trainer, batch_idx
        module = echo_module(pl_module)
        places = module.renderer.places_per_pose
        small = places is not None and places * len(batch.pose) < WORTH_THREADS
        small = small and not module.field.costly
        torch.set_num_threads(1 if small else self.most)

    def teardown(
        self, trainer: lightning.Trainer, pl_module: lightning.LightningModule, stage: str
    ) -> None:
        """Give all threads back."""
        del trainer, pl_module, stage
        torch.set_num_threads(self.most)
