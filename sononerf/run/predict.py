# SPDX-License-Identifier: MIT
"""Predict spectrograms of poses, heard or not, and compare where they were measured."""

from __future__ import annotations

import io
from pathlib import Path
from typing import BinaryIO, Literal

import numpy as np
import torch
from numpy.typing import NDArray

from sononerf import storage
from sononerf.array_types import Floats, Ints
from sononerf.echoes.echoes import Split
from sononerf.errors import InputError
from sononerf.evaluation.prediction import evenly, ranked
from sononerf.evaluation.prediction import predict as predict_poses
from sononerf.evaluation.traced import Traced
from sononerf.field.datamodule import WholePoses
from sononerf.field.fitting import poses_of
from sononerf.geometry.poses import Poses
from sononerf.head.decibels import compress
from sononerf.progress import Progress
from sononerf.report.pictures.spectrogram_picture import spectrogram_png
from sononerf.run.build import results_folder
from sononerf.run.fitted import NAME as TRACED_NAME
from sononerf.run.fitted import Fitted
from sononerf.run.run_folder import RunFolder

DRAWN = 3
"""Poses that are drawn where no number is given: the best, the median and the worst."""


def predict(
    run: Path | RunFolder,
    *,
    split: Split = "test",
    poses_csv: Path | None = None,
    output: Path | None = None,
    pictures: int | Literal["all"] = DRAWN,
    accelerator: str = "auto",
    progress: Progress | None = None,
) -> Path:
    """Predict spectrograms; where they were measured, compare.

    Args:
        run: A fitted run.
        split: Which poses of the ensemble.
        poses_csv: Poses of the user's instead: header ``x,y,z,yaw,pitch,roll``, metres and degrees.
        output: Folder of the results; ``RUN/prediction`` where None.
        pictures: How many poses are drawn: from the best to the worst where they were measured,
            else from the first to the last.
        accelerator: What to render on.
        progress: Where to show it.

    Returns:
        folder: With ``spectrograms.npz`` and pictures.

    Raises:
        InputError: If the run or the poses are none, a pose can hear nothing of what was fitted, or
            the folder is a run's.
    """
    progress = progress or Progress(quiet=True)
    run = RunFolder.of(run)
    own = Poses.read(poses_csv) if poses_csv else None
    fitted, settings = run.fitted, run.fitted.settings
    renderer = fitted.module.renderer
    kind = "" if own is None and split == "test" else f"-{'poses' if own is not None else split}"
    folder = output or run.path / f"prediction{kind}"
    if own is not None:
        _check_poses(own, poses_csv, fitted, progress)
        poses = WholePoses(
            torch.as_tensor(own.positions),
            torch.as_tensor(own.rotations),
            len(renderer.range),
            len(renderer.frequency),
        )
    else:
        poses = poses_of(run.echoes, split, renderer)
        if not len(poses):
            raise InputError(
                f"{run.echoes.store.path}: holds no {split} poses; choose another --split"
            )
    with run.locked(folder):
        traced = _traced(run, progress)
        with results_folder(folder):
            found = predict_poses(
                fitted,
                traced,
                poses,
                settings.simulation,
                seed=settings.fit.seed,
                accelerator=accelerator,
                progress=progress,
            )
            axes = {
                "range_m": renderer.range.double().numpy(),
                "frequency_hz": renderer.frequency.double().numpy(),
            }
            arrays = {"predicted": found.magnitude, "pose": poses.numbers.numpy(), **axes}
            if own is None:
                store = run.echoes.store
                arrays["measured"] = np.stack([store.read_pose(int(i)) for i in poses.numbers])
            arrays["position"] = poses.positions.numpy()
            arrays["rotation"] = poses.rotations.numpy()
            arrays["reference"] = np.asarray(found.reference)
            storage.commit(folder / "spectrograms.npz", lambda file: _save_npz(file, arrays))
            predicted = compress(found.magnitude, found.reference)
            measured = compress(arrays["measured"], found.reference) if own is None else None
            drawn = np.arange(len(poses)) if measured is None else ranked(measured, predicted)
            if pictures != "all":
                drawn = evenly(drawn, pictures)
            _pictures(folder, poses, np.unique(drawn), measured, predicted, axes, progress)
            if own is None and output is None and split == "test":
                numbers = found.numbers(run.echoes, arrays["measured"])
                run.write_metrics("prediction", {"split": split, **numbers})
    return folder


def _traced(run: RunFolder, progress: Progress) -> Traced | None:
    """Return the surface that echoes are traced off; warn where the run has lost its own."""
    traced = run.traced()
    known = (run.read_metrics().get("prediction") or {}).get("traced_weight", 0)
    if traced is None and known > 0:
        progress.say(
            f"{run.path / TRACED_NAME} is missing: the prediction is rendered from the field "
            "alone; the run's own also has echoes traced off its surface "
            f"(weight {known:.2f})"
        )
    return traced


def _check_poses(poses: Poses, csv: Path | None, fitted: Fitted, progress: Progress) -> None:
    """Refuse poses that can hear nothing of the region; say which lie within it."""
    lower, upper = (c.cpu().double().numpy() for c in fitted.module.field.region)
    ranges = fitted.module.renderer.range.cpu().double().numpy()
    below, above = lower - poses.positions, poses.positions - upper
    with np.errstate(over="ignore"):  # what is too far for a number is too far
        nearest = np.linalg.norm(np.maximum(np.maximum(below, above), 0), axis=1)
        farthest = np.linalg.norm(np.maximum(-below, -above), axis=1)
    deaf = np.flatnonzero((nearest > ranges[-1]) | (farthest < ranges[0]))
    if len(deaf):
        worst = deaf[0]
        where = f"{nearest[worst]:.3g} to {farthest[worst]:.3g} m"
        raise InputError(
            f"{csv}: from pose {worst} (the first is 0) the fitted region lies {where} away, and "
            f"what is heard is {ranges[0]:.3g} to {ranges[-1]:.3g} m; positions are in metres"
        )
    within = np.flatnonzero(nearest == 0)
    if len(within):
        numbers = ", ".join(map(str, within[:10])) + (" ..." if len(within) > 10 else "")
        progress.say(
            f"{csv}: within the fitted region, where no pose was trained, lie poses {numbers}"
        )


def _save_npz(file: BinaryIO, arrays: dict[str, NDArray[np.generic]]) -> None:
    buffer = io.BytesIO()
    np.savez_compressed(buffer, allow_pickle=False, **arrays)
    file.write(buffer.getbuffer())


def _pictures(
    folder: Path,
    poses: WholePoses,
    rows: Ints,
    measured: Floats | None,
    predicted: Floats,
    axes: dict[str, Floats],
    progress: Progress,
) -> None:
    with progress.task("drawing", len(rows)) as task:
        for row in rows:
            number = int(poses.numbers[row])
            picture = spectrogram_png(
                None if measured is None else measured[row],
                predicted[row],
                axes["range_m"],
                axes["frequency_hz"],
                f"pose {number}",
            )
            storage.commit_bytes(folder / f"pose_{number:04d}.png", picture)
            task.advance()
