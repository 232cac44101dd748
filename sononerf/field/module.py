# SPDX-License-Identifier: MIT
"""The LightningModule: field, renderer, loss and metrics. It writes no file."""

from __future__ import annotations

import math
from typing import Any, Literal

import lightning
import torch
from torch import Tensor
from torch.nn.utils import clip_grads_with_norm_, get_total_norm
from torchmetrics import MeanMetric

from sononerf.errors import NumericalError
from sononerf.field.datamodule import RangeSlices, seed_of
from sononerf.field.field import Field
from sononerf.field.renderer import Possible, Renderer
from sononerf.head.decibels import ACTIVE_DB, RANGE_DB

ENDLESS = 10**9
"""Steps of a fit whose Trainer knows no end: the learning rate is never lowered."""

WORTH_THREADS = 40_000
"""Places per step below which threads wait for one another longer than they compute.

Measured on two cores: with 12,000 places two threads take three quarters of the time of one on an
idle machine, and two and a half times as long as one where something else runs beside. That is of
lobes; a network computes so much for a place that threads never wait."""


def decibels(magnitude: Tensor, reference: float | Tensor) -> Tensor:
    """Compress: 20 log10(1 + m / m0), in dB; zero for silence."""
    return 20.0 * torch.log10(1.0 + magnitude / reference)


class EchoModule(lightning.LightningModule):
    """Fits a field through a renderer.

    Args:
        field: What is learned.
        renderer: How it is heard.
        reference: Magnitude m0 of the reported decibels.
        dynamic_range_db: How far below the loudest cell the fit's own compression starts.
        early_range_db: How far below each pose's own loudest cell it starts at first, so that the
            loud echoes, which come straight from a surface, settle before the faint ones, many of
            which are second bounces, can draw places to where nothing is. No more than
            ``dynamic_range_db`` is used.
        early_share: The share of the fit that this is for.
        possible: Which places the echoes leave possible.
        learning_rate: What Adam starts with.
        schedule: Constant for one half, then falling to ``final_rate_factor``; or times
            ``staircase_factor`` every ``staircase_epochs``.
        loss: On compressed spectra, 1 being the full dynamic range.
        silent_weight: Weight of cells that are silent in the measurement, beside 1.
        seed: All random numbers of a step come from the seed and the step.

    Attributes:
        total_steps, steps_per_epoch: Length of the fit; the Trainer's, once it fits.
    """

    def __init__(
        self,
        field: Field,
        renderer: Renderer,
        *,
        reference: float,
        dynamic_range_db: float,
        possible: Possible | None,
        learning_rate: float,
        early_range_db: float = 60.0,
        early_share: float = 0.0,
        schedule: Literal["cool", "staircase"] = "cool",
        final_rate_factor: float = 0.1,
        staircase_factor: float = 0.97,
        staircase_epochs: int = 10,
        loss: Literal["l1", "l2", "l1_4l2"] = "l1",
        silent_weight: float = 1.0,
        seed: int = 0,
    ) -> None:
        super().__init__()
        self.field = field
        self.renderer = renderer
        self.reference = reference
        self.dynamic_range_db = dynamic_range_db
        self.early_range_db = early_range_db
        self.early_share = early_share
        self.possible = possible
        self.learning_rate = learning_rate
        self.total_steps = self.steps_per_epoch = 1
        self.schedule = schedule
        self.final_rate_factor = final_rate_factor
        self.staircase_factor = staircase_factor
        self.staircase_epochs = staircase_epochs
        self.loss = loss
        self.silent_weight = silent_weight
        self.seed = seed
        self.mae = MeanMetric()
        self.mae_active = MeanMetric()

    def forward(self, batch: RangeSlices) -> Tensor:
        """Render a batch: (P, E, R, B) linear magnitude."""
        magnitude: Tensor = self.renderer(
            self.field, batch.position, batch.rotation, batch.rows, batch.bins
        )
        return magnitude

    def on_train_start(self) -> None:
        """Take over the length of the fit."""
        # Not earlier: Lightning would begin the first epoch before it has read a checkpoint.
        steps = float(self.trainer.estimated_stepping_batches)
        self.total_steps = int(steps) if math.isfinite(steps) else ENDLESS
        self.steps_per_epoch = int(self.trainer.num_training_batches)

    def on_train_batch_start(self, batch: RangeSlices, batch_index: int) -> None:
        """Choose torch's threads for this step; a function of the step's state alone."""
        del batch_index
        places = self.renderer.places_per_pose
        small = places is not None and places * len(batch.pose) < WORTH_THREADS
        torch.set_num_threads(1 if small and not self.field.costly else self._threads)

    def setup(self, stage: str) -> None:
        """Note the number of torch's threads."""
        del stage
        self._threads = torch.get_num_threads()

    def teardown(self, stage: str) -> None:
        """Give all threads back."""
        del stage
        torch.set_num_threads(self._threads)

    def training_step(self, batch: RangeSlices, batch_index: int) -> Tensor:
        """Return the loss of one batch."""
        del batch_index
        step = self.global_step
        self._seed(seed_of(self.seed, 3, step))
        self.field.advance(step, self.total_steps)
        self.renderer.advance(step, self.total_steps)
        if self.renderer.prepare(self.field, self.possible, step):
            with torch.no_grad():
                self.renderer.calibrate(self(batch), batch.spectrum)
                self._agree()
        loss = self._loss(self(batch), batch.spectrum)
        if self._is_logged(step):
            self.log("train/loss", loss, batch_size=len(batch.pose))
        return loss

    def _seed(self, number: int) -> None:
        if self.device.type == "cpu":
            # torch.manual_seed asks all other kinds of device too, a tenth of a small step.
            torch.default_generator.manual_seed(number)
        else:
            torch.manual_seed(number)

    def _is_logged(self, step: int) -> bool:
        """Whether somebody reads this step's loss: the logger, or a preview after an epoch."""
        every = int(getattr(self._trainer, "log_every_n_steps", 1))  # Lightning sets it untyped
        written = every > 0 and (step + 1) % every == 0
        return written or (step + 1) % self.steps_per_epoch == 0 or step + 1 == self.total_steps

    def _agree(self) -> None:
        """Give all devices one gain: each was calibrated on its own share of the batch."""
        if torch.distributed.is_available() and torch.distributed.is_initialized():
            for parameter in self.renderer.parameters():
                parameter.copy_(self.trainer.strategy.reduce(parameter.clone(), reduce_op="mean"))

    def range_db(self, step: int) -> float:
        """Return how far below the loudest cell the loss hears, at a step, in dB."""
        early = step < self.early_share * self.total_steps
        return min(self.early_range_db, self.dynamic_range_db) if early else self.dynamic_range_db

    def _loss(self, predicted: Tensor, measured: Tensor) -> Tensor:
        span = self.range_db(self.global_step)
        reference = self._reference(measured, span)
        # The difference of both decibels by fewer passes: every cell is looked at in each step.
        error = torch.log10((predicted + reference) / (measured + reference)) * (20.0 / span)
        if self.loss == "l1":
            cost = error.abs()
        elif self.loss == "l2":
            cost = 0.5 * error.square()
        else:
            cost = error.abs() + 4.0 * error.square()
        if self.silent_weight != 1.0:
            loudest = torch.maximum(predicted.detach(), measured)
            silent = decibels(loudest, reference) < ACTIVE_DB
            weight = torch.where(silent, self.silent_weight, 1.0)
            return (cost * weight).sum() / weight.sum()
        return cost.mean()

    def _reference(self, measured: Tensor, span: float) -> Tensor:
        """Return the magnitude at which the loss starts to hear, broadcastable over the batch."""
        least = measured.new_full((), self.reference * 10 ** ((RANGE_DB - span) / 20))
        if span == self.dynamic_range_db or not self.renderer.whole_poses:
            return least
        # By the pose's own loudest echo: the flash of a flat face must not silence all others.
        faintest = self.reference * 10 ** ((RANGE_DB - self.dynamic_range_db) / 20)
        loudest = measured.amax(dim=(1, 2, 3), keepdim=True)
        return (loudest * 10 ** (-span / 20)).clamp_min(faintest)

    def configure_gradient_clipping(
        self,
        optimizer: torch.optim.Optimizer,
        gradient_clip_val: float | None = None,
        gradient_clip_algorithm: str | None = None,
    ) -> None:
        """Clip the norm of the gradient; stop the fit if the gradient is not finite."""
        del optimizer, gradient_clip_algorithm
        named = {n: p for n, p in self.named_parameters() if p.grad is not None}
        norm = get_total_norm([p.grad for p in named.values() if p.grad is not None])
        # NaNs persist, so on a GPU it is enough to look at steps whose loss is logged.
        asked = self.renderer.may_ask or self._is_logged(self.global_step)
        if asked and not bool(norm.isfinite()):
            for name, parameter in named.items():
                if parameter.grad is not None and not bool(parameter.grad.isfinite().all()):
                    raise NumericalError(
                        f"the gradient of {name} is not finite at step {self.global_step}; "
                        "the last checkpoint is sound; lower fit.learning_rate and start anew with "
                        "--overwrite"
                    )
        if gradient_clip_val is not None:
            clip_grads_with_norm_(named.values(), gradient_clip_val, norm)

    def on_save_checkpoint(self, checkpoint: dict[str, Any]) -> None:
        """Refuse to save parameters that are not finite, so that the last checkpoint stays."""
        del checkpoint
        for name, parameter in self.named_parameters():
            if not bool(parameter.isfinite().all()):
                raise NumericalError(
                    f"{name} is not finite at step {self.global_step}; the last checkpoint is "
                    "sound; lower fit.learning_rate and start anew with --overwrite"
                )

    def validation_step(self, batch: RangeSlices, batch_index: int) -> None:
        """Gather the error over the validation poses, in reported decibels."""
        del batch_index
        self._gather(batch)

    def test_step(self, batch: RangeSlices, batch_index: int) -> None:
        """Gather the error over the test poses, in reported decibels."""
        del batch_index
        self._gather(batch)

    def _gather(self, batch: RangeSlices) -> None:
        predicted = decibels(self(batch), self.reference)
        measured = decibels(batch.spectrum, self.reference)
        error = (predicted - measured).abs()
        active = (predicted >= ACTIVE_DB) | (measured >= ACTIVE_DB)
        self.mae.update(error)
        if bool(active.any()):
            self.mae_active.update(error[active])

    def on_validation_epoch_end(self) -> None:
        """Log the error over the validation poses: ``val/mae_db``, ``val/mae_db_active``."""
        self._report("val")

    def on_test_epoch_end(self) -> None:
        """Log the error over the test poses: ``test/mae_db``, ``test/mae_db_active``."""
        self._report("test")

    def _report(self, split: str) -> None:
        self.log(f"{split}/mae_db", self.mae.compute(), prog_bar=True, sync_dist=True)
        if self.mae_active.update_count:
            active = self.mae_active.compute()
            self.log(f"{split}/mae_db_active", active, prog_bar=True, sync_dist=True)
        self.mae.reset()
        self.mae_active.reset()

    def predict_step(self, batch: RangeSlices, batch_index: int) -> Tensor:
        """Return the linear magnitude of a batch."""
        del batch_index
        return self(batch)

    def _rate(self, step: int) -> float:
        if self.schedule == "staircase":
            stairs = step // (self.staircase_epochs * self.steps_per_epoch)
            return float(self.staircase_factor**stairs)
        late = max(0.0, 2.0 * step / max(1, self.total_steps) - 1.0)
        return float(self.final_rate_factor**late)

    def configure_optimizers(self) -> Any:
        """Return Adam and the schedule, counted in steps."""
        # Fused: a pass over the dense grids in place of ten.
        optimizer = torch.optim.Adam(self.parameters(), lr=self.learning_rate, fused=True)
        scheduler = torch.optim.lr_scheduler.LambdaLR(optimizer, self._rate)
        return {
            "optimizer": optimizer,
            "lr_scheduler": {"scheduler": scheduler, "interval": "step"},
        }
