# SPDX-License-Identifier: MIT
"""TensorBoard: scalars with units, pictures, meshes, settings, results."""

from __future__ import annotations

import logging
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
TRIANGLES = 10_000
"""Largest number of triangles of a mesh in TensorBoard, 0.2 MB; larger meshes are decimated."""
PICTURES = 5
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
    return logger.experiment if last or epoch % PICTURES == 0 else None


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


def serve(run: Path) -> str:
    """Serve TensorBoard for a run on 127.0.0.1 until this process ends."""
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
