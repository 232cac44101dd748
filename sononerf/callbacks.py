# SPDX-License-Identifier: MIT
"""Callbacks of a fit: checkpoints, previews of mesh and projections each epoch, TensorBoard."""

from __future__ import annotations

import math
import signal
import threading
import time
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from types import FrameType
from typing import Any

import lightning
import numpy as np
import torch
import trimesh
from lightning.pytorch.loggers import TensorBoardLogger
from torch.utils.tensorboard import SummaryWriter

from sononerf import storage
from sononerf.errors import NumericalError, StoppedError
from sononerf.field.datamodule import WholePoses
from sononerf.field.field import Field
from sononerf.field.module import EchoModule, decibels
from sononerf.field.read_out import energy_volume
from sononerf.geometry.lattice import Volume, automatic_level, isosurface
from sononerf.progress import Task
from sononerf.report.figure import png_from_pixels
from sononerf.report.mesh_picture import decimated
from sononerf.report.mip_picture import maximum_intensity_projections, mip_image, mips_image
from sononerf.report.spectrogram_picture import quick_image, sounding_slice
from sononerf.start.surface import mesh_bytes


class ProgressCallback(lightning.Callback):
    """Moves a bar with every step."""

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
        del pl_module, outputs, batch, batch_idx
        note = f"epoch {trainer.current_epoch + 1} of {trainer.max_epochs}"
        error = trainer.callback_metrics.get("val/mae_db")
        if error is not None:
            note += f", validation {float(error):.2f} dB"
        self.task.advance(note=note)


SIGNALS = (signal.SIGINT, signal.SIGTERM, signal.SIGHUP)


class CheckpointCallback(lightning.Callback):
    """Keeps ``checkpoints/last.ckpt``; the fit resumes at its step."""

    def __init__(self, folder: Path, seconds: float) -> None:
        self.path = folder / "checkpoints" / "last.ckpt"
        self.seconds = seconds
        self.stopped_by: int | None = None
        self._saved = self._began = time.monotonic()
        self._earlier = 0.0
        self._total = math.inf
        self._before: dict[signal.Signals, Callable[..., Any] | int] = {}

    @property
    def elapsed(self) -> float:
        """Seconds of fitting so far, those before an interruption included."""
        return self._earlier + time.monotonic() - self._began

    def state_dict(self) -> dict[str, float]:
        """Return the state of this callback, for a checkpoint."""
        return {"elapsed": self.elapsed}

    def load_state_dict(self, state_dict: dict[str, float]) -> None:
        """Go on counting where the interrupted fit stopped."""
        self._earlier = float(state_dict["elapsed"])
        self._began = time.monotonic()

    @contextmanager
    def watching(self) -> Iterator[None]:
        """Turn signals into an orderly stop; a second signal has its usual effect."""
        if threading.current_thread() is threading.main_thread():
            for number in SIGNALS:
                handler = signal.getsignal(number)
                # Signals that were ignored at the start (nohup, a shell's &) stay ignored.
                if handler is not None and handler is not signal.SIG_IGN:
                    self._before[number] = handler
        self._watch()
        try:
            yield
        finally:
            self._let_go()

    def _watch(self) -> None:
        for number in self._before:
            signal.signal(number, self._note)

    def _let_go(self) -> None:
        for number, handler in self._before.items():
            signal.signal(number, handler)

    def _note(self, number: int, frame: FrameType | None) -> None:
        del frame
        if self.stopped_by is not None:
            self._let_go()
            signal.raise_signal(number)
        self.stopped_by = number

    def _save(self, trainer: lightning.Trainer) -> None:
        trainer.save_checkpoint(self.path)
        self._saved = time.monotonic()

    def _stop(self, trainer: lightning.Trainer) -> None:
        # Lightning's own way of stopping validates once more first.
        raise StoppedError(
            self.stopped_by or signal.SIGTERM,
            f"stopped at step {trainer.global_step} of {self._total:.0f}; the same command goes on",
        )

    def _is_asked_to_stop(self, trainer: lightning.Trainer) -> bool:
        # All devices stop together; a fit that is over has nothing to stop.
        asked = trainer.strategy.reduce_boolean_decision(self.stopped_by is not None, all=False)
        return asked and trainer.global_step < self._total

    def on_train_start(
        self, trainer: lightning.Trainer, pl_module: lightning.LightningModule
    ) -> None:
        """Take SIGTERM back from Lightning, which would end with exit code 0."""
        del pl_module
        self._total = float(trainer.estimated_stepping_batches)
        self._watch()

    def on_train_epoch_end(
        self, trainer: lightning.Trainer, pl_module: lightning.LightningModule
    ) -> None:
        """Save the state after the epoch's validation."""
        del pl_module
        self._save(trainer)
        if self._is_asked_to_stop(trainer):
            self._stop(trainer)

    def on_train_batch_end(
        self,
        trainer: lightning.Trainer,
        pl_module: lightning.LightningModule,
        outputs: Any,
        batch: Any,
        batch_idx: int,
    ) -> None:
        """Save when it is time, or before stopping."""
        del pl_module, outputs, batch, batch_idx
        if trainer.is_last_batch or trainer.global_step >= self._total:
            # Saved after the epoch: Lightning would go on from here without its end, and would
            # count wrongly after another stop.
            return
        must_stop = self._is_asked_to_stop(trainer)
        late = time.monotonic() - self._saved >= self.seconds
        if must_stop or trainer.strategy.reduce_boolean_decision(late, all=False):
            self._save(trainer)
        if must_stop:
            self._stop(trainer)


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


SHOWN_POSES = 3
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
        chosen = np.linspace(0, len(self.poses) - 1, min(SHOWN_POSES, len(self.poses))).astype(int)
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


FOLDER = "tensorboard"
SCALARS = {
    "train/loss": "training/loss",
    "val/mae_db": "validation_error_dB/all_cells",
    "val/mae_db_active": "validation_error_dB/active_cells",
}
"""Name in TensorBoard, with its unit, of each scalar that the module logs."""
MAX_TRIANGLES = 10_000
"""Largest number of triangles of a mesh in TensorBoard, 0.2 MB; larger meshes are decimated."""
PICTURE_EPOCHS = 5
"""Epochs between two pictures; those of the last epoch are always drawn."""


def event_folder(run: Path) -> Path:
    """Return the folder of a run's events; TensorBoard shows its name."""
    parent = run / FOLDER
    known = sorted(path for path in parent.glob("*") if path.is_dir())
    return known[0] if known else parent / (run.resolve().name or "run")


class RunLogger(TensorBoardLogger):
    """Logs a fit under the run's own name, with units."""

    def __init__(self, run: Path) -> None:
        super().__init__(run, name=FOLDER, version=event_folder(run).name, default_hp_metric=False)

    def log_metrics(self, metrics: Mapping[str, float], step: int | None = None) -> None:
        """Log scalars under their names with units; Lightning's count of epochs is left out."""
        named = {SCALARS.get(key, key): value for key, value in metrics.items() if key != "epoch"}
        super().log_metrics(named, step)

    def log_hyperparams(self, *given: Any, **more: Any) -> None:
        """Do nothing: settings are written with the results, see :func:`log_results`."""
        del given, more


def writer_of(trainer: lightning.Trainer) -> SummaryWriter | None:
    """Return the writer of a fit's pictures; None in most epochs, and without TensorBoard."""
    logger, epoch = trainer.logger, trainer.current_epoch + 1
    last = trainer.global_step >= trainer.estimated_stepping_batches
    if not trainer.is_global_zero or not isinstance(logger, TensorBoardLogger):
        return None
    return logger.experiment if last or epoch % PICTURE_EPOCHS == 0 else None


def add_mesh(writer: SummaryWriter, name: str, mesh: trimesh.Trimesh, step: int) -> None:
    """Show a mesh, m, with few triangles; TensorBoard turns it by mouse."""
    small = decimated(mesh, MAX_TRIANGLES)
    writer.add_mesh(
        name,
        torch.as_tensor(1e3 * np.asarray(small.vertices), dtype=torch.float32)[None],
        faces=torch.as_tensor(np.array(small.faces), dtype=torch.int32)[None],
        global_step=step,
    )


@contextmanager
def writing(run: Path) -> Iterator[SummaryWriter]:
    """Open the event files of a run for writing; close them at the end."""
    writer = SummaryWriter(str(event_folder(run)))
    try:
        yield writer
    finally:
        writer.close()


def log_results(run: Path, settings: Mapping[str, Any], metrics: Mapping[str, Any]) -> None:
    """Write settings with final numbers, so that TensorBoard's table compares runs."""
    prediction, geometry = metrics.get("prediction") or {}, metrics.get("geometry") or {}
    fscore = geometry.get("fscore") or {}
    results = {
        "final/held_out_error_all_cells_dB": prediction.get("mae_db"),
        "final/held_out_error_active_cells_dB": prediction.get("mae_db_active"),
        "final/field_alone_active_cells_dB": prediction.get("rendered_mae_db_active"),
        "final/Chamfer_mm": _scaled(geometry.get("chamfer_m"), 1e3),
        **{f"final/F-score_at_{1e3 * float(k):g}_mm": value for k, value in fscore.items()},
        "final/fit_s": (metrics.get("cost") or {}).get("fit_s"),
    }
    known = {name: float(value) for name, value in results.items() if value is not None}
    plain = {k: v for k, v in settings.items() if isinstance(v, (bool, int, float, str))}
    with writing(run) as writer:
        writer.add_hparams(plain, known, run_name=".")


def _scaled(value: float | None, factor: float) -> float | None:
    return None if value is None else factor * value
