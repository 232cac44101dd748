# SPDX-License-Identifier: MIT
"""One thread for small steps, all of them for large ones."""

from __future__ import annotations

from typing import Any

import lightning
import torch

from sononerf.callbacks.epoch import echo_module

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
