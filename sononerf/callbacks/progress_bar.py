# SPDX-License-Identifier: MIT
"""The fit's progress, in our epochs."""

from __future__ import annotations

from typing import Any

import lightning

from sononerf.callbacks.epoch import echo_module
from sononerf.progress import Task


class ProgressCallback(lightning.Callback):
    """Moves a bar with every step.

    Parameters
    ----------
    task : Task
        One count per step.
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
