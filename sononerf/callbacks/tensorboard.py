# SPDX-License-Identifier: MIT
"""TensorBoard: scalars with units, pictures, meshes, settings, results."""

from __future__ import annotations

import logging
import time
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import lightning
import numpy as np
import torch
import trimesh
from lightning.pytorch.loggers import TensorBoardLogger
from torch.utils.tensorboard import SummaryWriter

from sononerf.errors import ResourceError
from sononerf.report.surface_views import decimated

FOLDER = "tensorboard"
SCALARS = {
    "train/loss": "training/loss",
    "val/mae_db": "validation_error_dB/all_cells",
    "val/mae_db_active": "validation_error_dB/active_cells",
}
"""Name in TensorBoard, with its unit, of each scalar that the module logs."""
FLOORS = {
    "noise_floor_mae_db": "validation_error_dB/noise_floor_all_cells",
    "noise_floor_mae_db_active": "validation_error_dB/noise_floor_active_cells",
}
"""Name in TensorBoard of each noise floor."""
LAYOUT = {
    "validation error beside the noise floor, dB": {
        cells: [
            "Multiline",
            [f"validation_error_dB/{cells}", f"validation_error_dB/noise_floor_{cells}"],
        ]
        for cells in ("all_cells", "active_cells")
    }
}
TRIANGLES = 10_000
"""Largest number of triangles of a mesh in TensorBoard, 0.2 MB; larger meshes are decimated."""
SHARE, FIRST = 0.02, 10.0
"""Largest fraction of the fit's time that each kind of picture may take, and the time of the first
picture after the start, s. With these a fit of 40 s takes 1.4 s longer."""


def event_folder(run: Path) -> Path:
    """Return the folder of a run's events; TensorBoard shows its name."""
    parent = run / FOLDER
    known = sorted(path for path in parent.glob("*") if path.is_dir())
    return known[0] if known else parent / (run.resolve().name or "run")


class RunLogger(TensorBoardLogger):
    """Logs a fit under the run's own name, with units.

    Args:
        run: The run's folder.
        floors: Noise floors of the echoes, dB, by the names of ``FLOORS``; where known.
    """

    def __init__(self, run: Path, floors: Mapping[str, float | None] | None = None) -> None:
        folder = event_folder(run)
        super().__init__(run, name=FOLDER, version=folder.name, default_hp_metric=False)
        self.floors = {FLOORS[key]: value for key, value in (floors or {}).items() if value}

    def log_metrics(self, metrics: Mapping[str, float], step: int | None = None) -> None:
        """Log scalars under their names with units; Lightning's count of epochs is left out."""
        named = {SCALARS.get(key, key): value for key, value in metrics.items() if key != "epoch"}
        if "val/mae_db" in metrics:
            named |= self.floors
        super().log_metrics(named, step)

    def log_hyperparams(self, *given: Any, **more: Any) -> None:
        """Do nothing: settings are written with the results, see :func:`log_results`."""
        del given, more


class Shown(lightning.Callback):
    """Draws pictures for TensorBoard after an epoch, and limits the time that this takes."""

    def __init__(self) -> None:
        self.next_at = 0.0  # of the monotonic clock, s

    def on_train_start(
        self, trainer: lightning.Trainer, pl_module: lightning.LightningModule
    ) -> None:
        """Draw nothing in the first seconds, when there is little to see."""
        del trainer, pl_module
        self.next_at = time.monotonic() + FIRST

    def on_train_epoch_end(
        self, trainer: lightning.Trainer, pl_module: lightning.LightningModule
    ) -> None:
        """Draw, unless drawing would take more than its share; the last epoch is always drawn."""
        logger = trainer.logger
        if not trainer.is_global_zero or not isinstance(logger, TensorBoardLogger):
            return
        started = time.monotonic()
        total = trainer.estimated_stepping_batches
        if started < self.next_at and trainer.global_step < total:
            return
        was_training = pl_module.training
        pl_module.eval()
        try:
            with torch.inference_mode():
                self.draw(trainer, pl_module, logger.experiment)
        finally:
            pl_module.train(was_training)
        now = time.monotonic()
        self.next_at = now + (now - started) / SHARE

    def draw(
        self,
        trainer: lightning.Trainer,
        pl_module: lightning.LightningModule,
        writer: SummaryWriter,
    ) -> None:
        """Draw one epoch; subclasses implement it."""
        raise NotImplementedError


class Pace(lightning.Callback):
    """Logs how many steps per second an epoch took, and how the charts are laid out."""

    def __init__(self) -> None:
        self._began = (0, 0.0)

    def on_train_start(
        self, trainer: lightning.Trainer, pl_module: lightning.LightningModule
    ) -> None:
        """Write the layout: which curves share a chart."""
        del pl_module
        if trainer.is_global_zero and isinstance(trainer.logger, TensorBoardLogger):
            trainer.logger.experiment.add_custom_scalars(LAYOUT)

    def on_train_epoch_start(
        self, trainer: lightning.Trainer, pl_module: lightning.LightningModule
    ) -> None:
        """Start the clock of an epoch."""
        del pl_module
        self._began = (trainer.global_step, time.monotonic())

    def on_train_epoch_end(
        self, trainer: lightning.Trainer, pl_module: lightning.LightningModule
    ) -> None:
        """Log the mean over the epoch, its validation included."""
        del pl_module
        step, since = self._began
        seconds = time.monotonic() - since
        if trainer.logger is not None and seconds > 0 and trainer.global_step > step:
            pace = (trainer.global_step - step) / seconds
            trainer.logger.log_metrics({"training/steps_per_second": pace}, trainer.global_step)


def add_mesh(writer: SummaryWriter, name: str, mesh: trimesh.Trimesh, step: int) -> None:
    """Show a mesh, m, with few triangles; TensorBoard turns it by mouse."""
    small = decimated(mesh, TRIANGLES)
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
    """Write settings with final numbers, so that TensorBoard's table compares runs.

    Args:
        run: The run's folder.
        settings: By dotted key; lists and values of None are left out.
        metrics: ``metrics.json``.
    """
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


def serve(run: Path) -> str:
    """Serve TensorBoard for a run on 127.0.0.1 until this process ends.

    Returns:
        url: Its address.

    Raises:
        ResourceError: If it cannot be started.
    """
    from tensorboard import program

    board = program.TensorBoard()
    board.configure(
        argv=[None, "--logdir", str(run / FOLDER), "--host", "127.0.0.1", "--load_fast", "false"]
    )
    logging.getLogger("tensorboard").setLevel(logging.ERROR)
    logging.getLogger("werkzeug").setLevel(logging.ERROR)
    try:
        return str(board.launch())
    except (program.TensorBoardServerException, OSError) as error:
        raise ResourceError(f"TensorBoard does not start: {error}") from None
