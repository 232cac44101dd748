# SPDX-License-Identifier: MIT
"""Previews after each epoch: a coarse mesh, three projections, spectrograms of validation poses."""

from __future__ import annotations

from pathlib import Path

import lightning
import numpy as np
import torch
import trimesh
from torch.utils.tensorboard import SummaryWriter

from sononerf import storage
from sononerf.callbacks.tensorboard import Shown, add_mesh
from sononerf.errors import NumericalError
from sononerf.evaluation.metrics import chamfer_distance
from sononerf.evaluation.solid import Solid
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

    Args:
        folder: The run.
        every_epochs: Number of epochs between two previews.
        voxels: Along the region's longest side.
        directions: Spherical lattice for fields without lobes.

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


SAMPLES = 4000
"""Samples of each surface for the Chamfer distance of a preview: right to some percent."""


class SurfaceImages(Shown):
    """Shows the preview: projections with axes, the mesh, and its distance from the truth.

    Args:
        preview: Callback with the read-out; it must run before.
        truth: The true surface, m; None where it is not known.
    """

    def __init__(self, preview: PreviewCallback, truth: trimesh.Trimesh | None = None) -> None:
        super().__init__()
        self.preview, self._truth = preview, truth
        self._solid: Solid | None = None

    def draw(
        self,
        trainer: lightning.Trainer,
        pl_module: lightning.LightningModule,
        writer: SummaryWriter,
    ) -> None:
        """Show the last preview."""
        del pl_module
        volume, mesh, step = self.preview.volume, self.preview.mesh, trainer.global_step
        if volume is not None and volume.values.max() > 0:
            writer.add_image("projections", mips_image(volume), step, dataformats="HWC")
        if mesh is None:
            return
        add_mesh(writer, "mesh/field", mesh, step)
        if self._truth is not None:
            self._solid = self._solid or Solid(self._truth)
            distance = chamfer_distance(mesh, self._solid, samples=SAMPLES)
            writer.add_scalar("Chamfer_mm/field", 1e3 * distance, step)


POSES = 3
"""Validation poses that are shown, evenly chosen; always the same ones."""


class SpectrogramImages(Shown):
    """Shows validation poses: measured, predicted by the field, and the difference.

    Args:
        poses: The validation poses.
        range_m, frequency_hz ((R,), (F,) float): Axes.
    """

    def __init__(
        self, poses: WholePoses, range_m: torch.Tensor, frequency_hz: torch.Tensor
    ) -> None:
        super().__init__()
        self.poses = poses
        self.range_m = range_m.double().numpy()
        self.frequency_hz = frequency_hz.double().numpy()

    def draw(
        self,
        trainer: lightning.Trainer,
        pl_module: lightning.LightningModule,
        writer: SummaryWriter,
    ) -> None:
        """Render the poses and show them."""
        if not isinstance(pl_module, EchoModule):
            return
        chosen = np.linspace(0, len(self.poses) - 1, min(POSES, len(self.poses))).astype(int)
        for number in chosen.tolist():
            batch = trainer.strategy.batch_to_device(self.poses[number])
            measured, predicted = (
                decibels(part, pl_module.reference)[0].cpu().numpy()
                for part in (batch.spectrum, pl_module(batch))
            )
            shown = sounding_slice(np.stack([measured, predicted]), self.range_m)
            levels = {"measured": measured[:, shown], "predicted": predicted[:, shown]}
            picture = quick_image(levels, self.range_m[shown], self.frequency_hz)
            name = f"spectrogram/validation_pose_{number}"
            writer.add_image(name, picture, trainer.global_step, dataformats="HWC")
