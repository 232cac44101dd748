# SPDX-License-Identifier: MIT
"""Measured, predicted and their difference in TensorBoard, epoch by epoch."""

from __future__ import annotations

import time

import lightning
import torch
from lightning.pytorch.loggers import TensorBoardLogger

from sononerf.callbacks.epoch import EpochCallback
from sononerf.field.module import EchoModule, decibels
from sononerf.field.range_slices import WholePoses
from sononerf.report.pictures.spectrogram_picture import spectrogram_image

SHARE = 0.05
"""Part of the time that drawing may take; short epochs may go without a picture, but the last."""


class SpectrogramImages(EpochCallback):
    """Shows the first validation pose.

    Parameters
    ----------
    poses : WholePoses
        The validation poses.
    range_m, frequency_hz : (R,), (F,) float
        Axes.
    """

    def __init__(
        self, poses: WholePoses, range_m: torch.Tensor, frequency_hz: torch.Tensor
    ) -> None:
        self.poses = poses
        self.range_m = range_m.double().numpy()
        self.frequency_hz = frequency_hz.double().numpy()
        self.next_at = 0.0  # of the monotonic clock, s

    def on_epoch(self, trainer: lightning.Trainer, module: EchoModule, epoch: int) -> None:
        """Render one pose and show it."""
        del epoch
        if not trainer.is_global_zero or not isinstance(trainer.logger, TensorBoardLogger):
            return
        if not len(self.poses):
            return
        started = time.monotonic()
        if started < self.next_at and module.global_step < trainer.max_steps:
            return
        batch = trainer.strategy.batch_to_device(self.poses[0])
        was_training = module.training
        module.eval()
        try:
            with torch.inference_mode():
                predicted = decibels(module(batch), module.reference)[0]
        finally:
            module.train(was_training)
        measured = decibels(batch.spectrum, module.reference)[0]
        picture = spectrogram_image(
            measured.cpu().numpy(), predicted.cpu().numpy(), self.range_m, self.frequency_hz
        )
        trainer.logger.experiment.add_image(
            "spectrogram", picture, module.global_step, dataformats="HWC"
        )
        now = time.monotonic()
        self.next_at = now + (now - started) / SHARE
