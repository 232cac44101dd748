# SPDX-License-Identifier: MIT
"""Predict spectrograms of poses, heard or not, and compare where they were measured."""

from __future__ import annotations

import io
from pathlib import Path
from typing import BinaryIO

import numpy as np
import torch
from numpy.typing import NDArray

from sononerf import storage
from sononerf.echoes.store import EnsembleStore
from sononerf.errors import InputError
from sononerf.evaluation.mixture import mix
from sononerf.evaluation.prediction import prediction_metrics
from sononerf.field.range_slices import WholePoses
from sononerf.field.renderer import Renderer
from sononerf.geometry.poses import Poses, read_pose_csv
from sononerf.head.decibels import compress, mae_db
from sononerf.progress import Progress
from sononerf.report.pictures.spectrogram_picture import spectrogram_png
from sononerf.run.fitted import (
    Fitted,
    Split,
    load_fitted,
    poses_of,
    render_poses,
    store_of,
)
from sononerf.run.run_folder import RunFolder, results_folder
from sononerf.run.traced import NAME as TRACED_NAME
from sononerf.run.traced import load_traced, trace_poses


def predict(
    path: Path,
    *,
    split: Split = "test",
    poses_csv: Path | None = None,
    output: Path | None = None,
    accelerator: str = "auto",
    progress: Progress | None = None,
) -> Path:
    """Predict spectrograms; where they were measured, compare.

    Parameters
    ----------
    path : Path
        A fitted run.
    split : {"test", "val", "train"}
        Which poses of the ensemble.
    poses_csv : Path or None
        Poses of the user's instead: header ``x,y,z,yaw,pitch,roll``, metres and degrees.
    output : Path or None
        Folder of the results; ``RUN/prediction`` where None.
    accelerator : {"auto", "cpu", "gpu"}
        What to render on.
    progress : Progress or None
        Where to show it.

    Returns
    -------
    folder : Path
        With ``spectrograms.npz`` and a picture per pose.

    Raises
    ------
    InputError
        If the run or the poses are none, a pose can hear nothing of what was fitted, or the folder
        is a run's.
    """
    progress = progress or Progress(quiet=True)
    run = RunFolder(path)
    own = read_pose_csv(poses_csv) if poses_csv else None
    fitted = load_fitted(path)
    renderer = fitted.module.renderer
    folder = output or path / (
        "prediction"
        if own is None and split == "test"
        else f"prediction-{'poses' if own is not None else split}"
    )
    if own is not None:
        _check_poses(own, poses_csv, fitted, progress)
    store = None if own is not None else store_of(fitted)
    surface = load_traced(path)
    known = (run.read_metrics().get("prediction") or {}).get("traced_weight", 0)
    if surface is None and known > 0:
        progress.say(
            f"{path / TRACED_NAME} is missing: the prediction is rendered from the field alone; "
            f"the run's own also has echoes traced off its surface (weight {known:.2f})"
        )
    poses = _poses_to_render(store, own, split, renderer)
    with results_folder(folder):
        rendered = render_poses(fitted, poses, accelerator=accelerator, progress=progress)
        magnitude, reference = rendered, fitted.module.reference
        if surface is not None and surface.weight.any():
            traced = trace_poses(fitted, surface, poses, progress=progress)
            both = compress(rendered, reference), compress(traced, reference)
            level = mix(*both, surface.weight)
            magnitude = (reference * (10 ** (level / 20) - 1)).astype(np.float32)
        axes = {
            "range_m": renderer.range.double().numpy(),
            "frequency_hz": renderer.frequency.double().numpy(),
        }
        arrays = {"predicted": magnitude, "pose": poses.numbers.numpy(), **axes}
        measured = None
        if store is not None:
            arrays["measured"] = np.stack([store.read_pose(int(i)) for i in poses.numbers])
            measured = compress(arrays["measured"], reference)
        arrays["position"] = poses.positions.numpy()
        arrays["rotation"] = poses.rotations.numpy()
        arrays["reference"] = np.asarray(reference)
        storage.commit(folder / "spectrograms.npz", lambda file: _save_npz(file, arrays))
        predicted = compress(magnitude, reference)
        _pictures(folder, poses, measured, predicted, axes, progress)
    if store is not None and measured is not None and output is None and split == "test":
        figures = _numbers(store, split, measured, predicted, reference)
        alone = compress(rendered, reference)
        run.write_metrics(
            "prediction",
            {
                **figures,
                "rendered_mae_db": mae_db(measured, alone),
                "rendered_mae_db_active": mae_db(measured, alone, active=True),
                "traced_weight": 0.0 if surface is None else float(surface.weight.mean()),
            },
        )
    return folder


def _check_poses(poses: Poses, csv: Path | None, fitted: Fitted, progress: Progress) -> None:
    """Refuse poses that can hear nothing of the region; say which lie within it."""
    lower, upper = (c.double().cpu().numpy() for c in fitted.module.field.region)
    ranges = fitted.module.renderer.range.double().cpu().numpy()
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


def _poses_to_render(
    store: EnsembleStore | None, own: Poses | None, split: Split, renderer: Renderer
) -> WholePoses:
    if own is not None:
        return WholePoses(
            torch.as_tensor(own.positions),
            torch.as_tensor(own.rotations),
            len(renderer.range),
            len(renderer.frequency),
        )
    if store is None:
        raise InputError("neither an ensemble nor poses to predict")
    poses = poses_of(store, split, renderer)
    if not len(poses):
        raise InputError(f"{store.path}: holds no {split} poses; choose another --split")
    return poses


def _pictures(
    folder: Path,
    poses: WholePoses,
    measured: NDArray[np.float64] | None,
    predicted: NDArray[np.float64],
    axes: dict[str, NDArray[np.float64]],
    progress: Progress,
) -> None:
    with progress.task("drawing", len(poses)) as task:
        for row, number in enumerate(poses.numbers.tolist()):
            picture = spectrogram_png(
                None if measured is None else measured[row],
                predicted[row],
                axes["range_m"],
                axes["frequency_hz"],
                f"pose {number}",
            )
            storage.commit_bytes(folder / f"pose_{number:04d}.png", picture)
            task.advance()


def _numbers(
    store: EnsembleStore,
    split: Split,
    measured: NDArray[np.float64],
    predicted: NDArray[np.float64],
    reference: float,
) -> dict[str, object]:
    train = store.indices("train")
    mean = np.zeros(measured.shape[1:])
    for index in train:
        mean += compress(store.read_pose(int(index)), reference) / len(train)
    floor = ("noise_floor_mae_db", "noise_floor_mae_db_active")
    return {
        "split": split,
        "poses": len(measured),
        **prediction_metrics(measured, predicted, mean_db=mean),
        **{key: store.attributes.get(key) for key in floor},
    }
