# SPDX-License-Identifier: MIT
"""Previews after each epoch: a coarse mesh, three projections, spectrograms of validation poses."""

from __future__ import annotations

from pathlib import Path

import lightning
import numpy as np
import torch
import trimesh

from sononerf import storage
from sononerf.callbacks.tensorboard import add_mesh, writer_of
from sononerf.errors import NumericalError
from sononerf.field.field import Field
from sononerf.field.module import EchoModule, decibels
from sononerf.field.range_slices import WholePoses
from sononerf.report.pictures.figure import png_from_pixels
from sononerf.report.pictures.mip_picture import (
    maximum_intensity_projections,
    mip_image,
    mips_image,
)
from sononerf.report.pictures.spectrogram_picture import quick_image, sounding_slice
from sononerf.surface.mesh_files import mesh_bytes
from sononerf.surface.start.read_out import energy_volume
from sononerf.surface.start.volume import Volume, automatic_level, isosurface


class PreviewCallback(lightning.Callback):
    """Writes ``epochs/0001/``: a coarse mesh, three projections and the numbers so far.

    Attributes:
        volume, mesh: Last read-out; None if there was no surface.
    """

    def __init__(self, folder: Path, *, every_epochs: int, voxels: int, directions: int) -> None:
        self.folder = folder
        self.every_epochs = every_epochs
        self.voxels = voxels
        self.directions = directions
        self.volume: Volume | None = None
        self.mesh: trimesh.Trimesh | None = None

    def on_train_epoch_end(
        self, trainer: lightning.Trainer, pl_module: lightning.LightningModule
    ) -> None:
        """Read the field out coarsely and write its pictures."""
        field, epoch = getattr(pl_module, "field", None), trainer.current_epoch + 1
        if epoch % self.every_epochs or not trainer.is_global_zero or not isinstance(field, Field):
            return
        target = self.folder / "epochs" / f"{epoch:04d}"
        shown = {k: float(v) for k, v in trainer.callback_metrics.items()}
        numbers = {**shown, "epoch": epoch, "step": trainer.global_step}
        extent = float((field.region[1] - field.region[0]).max())
        was_training = pl_module.training
        pl_module.eval()
        self.volume = self.mesh = None
        try:
            with torch.inference_mode():
                spacing = max(extent / self.voxels, field.resolution / 2)
                self.volume = energy_volume(field, spacing, self.directions)
                self.mesh = isosurface(self.volume, automatic_level(self.volume))
        except NumericalError as error:
            # An early field may hold no surface yet; that is news, not a fault.
            storage.commit_json(target / "metrics.json", {**numbers, "no_surface": str(error)})
            return
        finally:
            pl_module.train(was_training)
        storage.commit_bytes(target / "mesh.ply", mesh_bytes(self.mesh, "ply"))
        # Bare pixels: axes and labels would cost more than the rest of the epoch's look.
        for axis, projection in maximum_intensity_projections(self.volume).items():
            data = png_from_pixels(mip_image(projection))
            storage.commit_bytes(target / f"mip_{axis}.png", data)
        storage.commit_json(target / "metrics.json", numbers)
        if writer := writer_of(trainer):
            writer.add_image(
                "projections", mips_image(self.volume), trainer.global_step, dataformats="HWC"
            )
            add_mesh(writer, "mesh/field", self.mesh, trainer.global_step)


POSES = 3
"""Validation poses that are shown, evenly chosen; always the same ones."""


class SpectrogramImages(lightning.Callback):
    """Shows validation poses: measured, and predicted by the field.

    In: range_m, frequency_hz ((R,), (F,) float).
    """

    def __init__(
        self, poses: WholePoses, range_m: torch.Tensor, frequency_hz: torch.Tensor
    ) -> None:
        self.poses = poses
        self.range_m = range_m.double().numpy()
        self.frequency_hz = frequency_hz.double().numpy()

    def on_train_epoch_end(
        self, trainer: lightning.Trainer, pl_module: lightning.LightningModule
    ) -> None:
        """Render the poses and show them."""
        writer = writer_of(trainer)
        if writer is None or not isinstance(pl_module, EchoModule):
            return
        was_training = pl_module.training
        pl_module.eval()
        chosen = np.linspace(0, len(self.poses) - 1, min(POSES, len(self.poses))).astype(int)
        for number in chosen.tolist():
            batch = trainer.strategy.batch_to_device(self.poses[number])
            with torch.inference_mode():
                measured, predicted = (
                    decibels(part, pl_module.reference)[0].cpu().numpy()
                    for part in (batch.spectrum, pl_module(batch))
                )
            shown = sounding_slice(np.stack([measured, predicted]), self.range_m)
            levels = {"measured": measured[:, shown], "predicted": predicted[:, shown]}
            picture = quick_image(levels, self.range_m[shown], self.frequency_hz)
            name = f"spectrogram/validation_pose_{number}"
            writer.add_image(name, picture, trainer.global_step, dataformats="HWC")
        pl_module.train(was_training)
