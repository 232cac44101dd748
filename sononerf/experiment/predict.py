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
from sononerf.acoustics.spectrogram import compress
from sononerf.data.range_slices import WholePoses
from sononerf.data.store import EnsembleStore
from sononerf.errors import InputError
from sononerf.experiment.fitted import Split, load_fitted, poses_of, render_poses, store_of
from sononerf.experiment.retrace import load_retrace, trace_poses
from sononerf.experiment.run_folder import RunFolder
from sononerf.geometry.poses import Poses, read_pose_csv
from sononerf.progress import Progress
from sononerf.reconstruction.prediction import mae_db, prediction_metrics
from sononerf.reconstruction.retrace import blend
from sononerf.render.spectrogram import spectrogram_png
from sononerf.renderer.renderer import Renderer


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
    store = None if own is not None else store_of(fitted)
    retrace = load_retrace(path)
    poses = _poses_to_render(store, own, split, renderer)
    storage.probe_writable(folder)
    rendered = render_poses(fitted, poses, accelerator=accelerator, progress=progress)
    reference = fitted.module.reference
    magnitude = rendered
    if retrace is not None and retrace.share > 0:
        traced = trace_poses(fitted.settings, retrace, poses, progress=progress)
        magnitude = blend(rendered, traced, retrace.share, reference).astype(np.float32)
    predicted = compress(magnitude, reference)
    measured = None
    if store is not None:
        measured = compress(np.stack([store.read_pose(int(i)) for i in poses.numbers]), reference)
    axes = {
        "range_m": renderer.range.double().numpy(),
        "frequency_hz": renderer.frequency.double().numpy(),
    }
    arrays = {"predicted": magnitude, "pose": poses.numbers.numpy(), **axes}
    if measured is not None and store is not None:
        arrays["measured"] = np.stack([store.read_pose(int(i)) for i in poses.numbers])
    arrays["position"] = poses.positions.numpy()
    arrays["rotation"] = poses.rotations.numpy()
    arrays["reference"] = np.asarray(reference)
    storage.commit(folder / "spectrograms.npz", lambda file: _save_npz(file, arrays))
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
                "traced_share": 0.0 if retrace is None else retrace.share,
            },
        )
    return folder


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
                predicted[row] if measured is None else measured[row],
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
