# SPDX-License-Identifier: MIT
"""What each epoch shows: a coarse mesh, three projections, spectrograms of validation poses."""

from __future__ import annotations

import time
from pathlib import Path

import lightning
import torch
from lightning.pytorch.loggers import TensorBoardLogger

from sononerf import storage
from sononerf.errors import NumericalError
from sononerf.field.field import Field
from sononerf.field.module import EchoModule, decibels
from sononerf.field.range_slices import WholePoses
from sononerf.report.pictures.figure import png_from_pixels
from sononerf.report.pictures.mip_picture import maximum_intensity_projections, mip_image
from sononerf.report.pictures.spectrogram_picture import spectrogram_image
from sononerf.surface.mesh_files import mesh_bytes
from sononerf.surface.start.read_out import energy_volume
from sononerf.surface.start.volume import automatic_level, isosurface


class PreviewCallback(lightning.Callback):
    """Writes ``epochs/0001/`` and shows the projections in TensorBoard.

    Args:
        folder: The run.
        every_epochs: How often.
        voxels: Along the region's longest side.
        directions: Spherical lattice for fields without lobes.
    """

    def __init__(self, folder: Path, *, every_epochs: int, voxels: int, directions: int) -> None:
        self.folder = folder
        self.every_epochs = every_epochs
        self.voxels = voxels
        self.directions = directions

    def on_train_epoch_end(
        self, trainer: lightning.Trainer, pl_module: lightning.LightningModule
    ) -> None:
        """Read the field out coarsely and write what is seen."""
        field, epoch = getattr(pl_module, "field", None), trainer.current_epoch + 1
        if epoch % self.every_epochs or not trainer.is_global_zero or not isinstance(field, Field):
            return
        target = self.folder / "epochs" / f"{epoch:04d}"
        shown = {k: float(v) for k, v in trainer.callback_metrics.items()}
        numbers = {**shown, "epoch": epoch, "step": trainer.global_step}
        extent = float((field.region[1] - field.region[0]).max())
        was_training = pl_module.training
        pl_module.eval()
        try:
            with torch.inference_mode():
                spacing = max(extent / self.voxels, field.resolution / 2)
                volume = energy_volume(field, spacing, self.directions)
                mesh = isosurface(volume, automatic_level(volume))
        except NumericalError as error:
            # An early field may hold no surface yet; that is news, not a fault.
            storage.commit_json(target / "metrics.json", {**numbers, "no_surface": str(error)})
            return
        finally:
            pl_module.train(was_training)
        storage.commit_bytes(target / "mesh.ply", mesh_bytes(mesh, "ply"))
        # Bare pixels: axes and labels would cost more than the rest of the epoch's look.
        pictures = {
            axis: mip_image(projection)
            for axis, projection in maximum_intensity_projections(volume).items()
        }
        for axis, pixels in pictures.items():
            storage.commit_bytes(target / f"mip_{axis}.png", png_from_pixels(pixels))
        storage.commit_json(target / "metrics.json", numbers)
        if isinstance(trainer.logger, TensorBoardLogger):
            for axis, pixels in pictures.items():
                trainer.logger.experiment.add_image(
                    f"mip/{axis}", pixels, trainer.global_step, dataformats="HWC"
                )


SHARE = 0.05
"""Part of the time that drawing may take; short epochs may go without a picture, but the last."""


class SpectrogramImages(lightning.Callback):
    """Shows the first validation pose.

    Args:
        poses: The validation poses.
        range_m, frequency_hz ((R,), (F,) float): Axes.
    """

    def __init__(
        self, poses: WholePoses, range_m: torch.Tensor, frequency_hz: torch.Tensor
    ) -> None:
        self.poses = poses
        self.range_m = range_m.double().numpy()
        self.frequency_hz = frequency_hz.double().numpy()
        self.next_at = 0.0  # of the monotonic clock, s

    def on_train_epoch_end(
        self, trainer: lightning.Trainer, pl_module: lightning.LightningModule
    ) -> None:
        """Render one pose and show it."""
        module = pl_module
        if not trainer.is_global_zero or not isinstance(trainer.logger, TensorBoardLogger):
            return
        if not len(self.poses) or not isinstance(module, EchoModule):
            return
        started = time.monotonic()
        if started < self.next_at and module.global_step < module.total_steps:
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
