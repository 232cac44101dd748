# SPDX-License-Identifier: MIT
"""Our epochs, counted from the step: the fit is one endless epoch to Lightning."""

from __future__ import annotations

from typing import Any

import lightning

from sononerf.field.module import EchoModule


def echo_module(module: lightning.LightningModule) -> EchoModule:
    """Return the module that the callbacks here are made for.

    Raises
    ------
    TypeError
        If it is another one.
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
