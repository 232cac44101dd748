# SPDX-License-Identifier: MIT
"""Prediction of spectrograms at any poses, compared where measured; proposal of the next poses."""

from __future__ import annotations

import io
import logging
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any, BinaryIO, Literal

import numpy as np
from numpy.typing import NDArray

from sononerf import storage
from sononerf.echoes.echoes import Split
from sononerf.errors import InputError
from sononerf.evaluation.prediction import (
    Prediction,
    check_hearing,
    evenly,
    prediction_numbers,
    ranked,
)
from sononerf.evaluation.prediction import predict as predict_poses
from sononerf.evaluation.traced import Traced
from sononerf.geometry.poses import FrameName, Poses, aim_fault
from sononerf.head.front_end import compress
from sononerf.numerics import Floats, Ints, Singles
from sononerf.progress import Progress
from sononerf.recordings.pose_tables import read_table, to_poses
from sononerf.refinement.surface_error import Within, next_poses
from sononerf.report.spectrogram_picture import spectrogram_picture
from sononerf.run.build import NAME as TRACED_NAME
from sononerf.run.build import results_folder
from sononerf.run.run import Run, open_run
from sononerf.settings.loading import read_import_settings


def propose(
    run: Path, count: int, candidates: Path | None, within: Within, output: Path | None
) -> Path:
    """Write the poses that would reduce the error of a run's surface most, the best first."""
    opened = open_run(run)
    file = output or opened.path / "next.csv"
    if file.is_dir():
        raise InputError(f"{file}: is a folder; give --output the name of a file")
    given = None if candidates is None else read_poses(opened, candidates)
    with opened.locked(file.parent):
        proposed = next_poses(
            opened.surface,
            opened.echoes,
            count,
            candidates=given,
            within=within,
            seed=opened.settings.fit.seed,
        )
        storage.commit_bytes(file, proposed.table().encode())
    return file


logger = logging.getLogger("sononerf")


def read_poses(run: Run, path: Path, frame: FrameName = "auto") -> Poses:
    """Read a table of poses."""
    stated = run.provenance.get("poses_as")
    recorded = run.provenance.get("origin") == "recorded"
    if frame == "world" or not stated or (frame == "auto" and not recorded):
        return Poses.read(path)
    settings = read_import_settings(stated, "the run's provenance")
    return to_poses(read_table(path, settings), settings)


DRAWN_POSES = 3
"""Poses that are drawn where no number is given: the best, the median and the worst."""


def predict(
    run: Path | Run,
    *,
    split: Split = "test",
    poses_csv: Path | None = None,
    frame: FrameName = "auto",
    output: Path | None = None,
    pictures: int | Literal["all"] = DRAWN_POSES,
    accelerator: str = "auto",
    progress: Progress | None = None,
) -> Path:
    """Predict spectrograms; where they were measured, compare.

    Args:
        run: A fitted run.
        split: Split whose poses are predicted.
        poses_csv: Poses of the user's instead; see :func:`read_poses`.
        frame: Frame of these poses.
        output: Folder of the results; ``RUN/prediction`` by default.
        pictures: Number of poses that are drawn: from the best to the worst where they were
            measured, else from the first to the last.
        accelerator: Device to render on.
        progress: Display of progress.

    Returns:
        folder: With ``spectrograms.npz`` and pictures.

    Raises:
        InputError: If the run or the poses cannot be read, a pose cannot hear the fitted region, or
            the folder is a run's.
    """
    progress = progress or Progress(quiet=True)
    run = Run.of(run)
    own = read_poses(run, poses_csv, frame) if poses_csv else None
    model, settings = run.model, run.settings
    kind = "" if own is None and split == "test" else f"-{'poses' if own is not None else split}"
    folder = output or run.path / f"prediction{kind}"
    if own is not None:
        poses, numbers = own, np.arange(len(own))
        with _named(poses_csv):
            check_hearing(model, poses)
        fault = aim_fault(poses, model.field.region.double().numpy().mean(axis=0))
        if fault and settings.ears.is_directional:
            logger.warning("%s: %s", poses_csv, fault)
    else:
        poses, numbers = run.echoes.poses(split), run.echoes.store.indices(split)
        if not len(poses):
            raise InputError(
                f"{run.echoes.store.path}: holds no {split} poses; choose another --split"
            )
    with run.locked(folder):
        traced = _traced(run)
        with results_folder(folder):
            prediction = predict_poses(
                model,
                traced,
                poses,
                options=settings.simulation,
                accelerator=accelerator,
                progress=progress,
            )
            axes = {"range_m": prediction.range, "frequency_hz": prediction.frequency}
            arrays: dict[str, NDArray[Any]] = {
                "predicted": prediction.magnitude,
                "pose": numbers,
                **axes,
            }
            if prediction.error_db is not None:
                arrays["error_db"] = prediction.error_db
            measured: Singles | None = None
            if own is None:
                measured = np.stack([run.echoes.spectrogram(int(i)) for i in numbers])
                arrays["measured"] = measured
            arrays["position"], arrays["rotation"] = poses.positions, poses.rotations
            arrays["reference"] = np.asarray(prediction.reference)
            storage.commit(folder / "spectrograms.npz", lambda file: _save_npz(file, arrays))
            level = None if measured is None else compress(measured, prediction.reference)
            drawn = np.arange(len(poses)) if level is None else ranked(level, prediction.level_db)
            if pictures != "all":
                drawn = evenly(drawn, pictures)
            _pictures(folder, prediction, numbers, np.unique(drawn), level, progress)
            if measured is not None and output is None and split == "test":
                metrics = prediction_numbers(prediction, run.echoes, measured)
                run.write_metrics("prediction", {"split": split, **metrics})
    return folder


@contextmanager
def _named(file: Path | None) -> Iterator[None]:
    """Name the file of poses in errors about them."""
    try:
        yield
    except InputError as error:
        raise InputError(f"{file}: {error}") from None


def _traced(run: Run) -> Traced | None:
    """Return the surface that echoes are traced off; warn where the run has lost its own."""
    traced = run.traced()
    weight = (run.read_metrics().get("prediction") or {}).get("traced_weight", 0)
    if traced is None and weight > 0:
        logger.warning(
            "%s is missing: the prediction is rendered from the field alone; the run's own also "
            "has echoes traced off its surface (weight %.2f)",
            *(run.path / TRACED_NAME, weight),
        )
    return traced


def _save_npz(file: BinaryIO, arrays: dict[str, NDArray[np.generic]]) -> None:
    buffer = io.BytesIO()
    np.savez_compressed(buffer, allow_pickle=False, **arrays)
    file.write(buffer.getbuffer())


def _pictures(
    folder: Path,
    prediction: Prediction,
    numbers: Ints,
    rows: Ints,
    measured: Floats | None,
    progress: Progress,
) -> None:
    predicted = prediction.level_db
    with progress.task("drawing", len(rows)) as task:
        for row in rows:
            number = int(numbers[row])
            picture = spectrogram_picture(
                None if measured is None else measured[row],
                predicted[row],
                prediction.range,
                prediction.frequency,
                f"pose {number}",
            )
            storage.commit_bytes(folder / f"pose_{number:04d}.png", picture)
            task.advance()
