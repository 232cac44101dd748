# SPDX-License-Identifier: MIT
"""Predict spectrograms of poses, heard or not, and compare where they were measured."""

from __future__ import annotations

import io
from dataclasses import dataclass
from pathlib import Path
from typing import BinaryIO, Literal

import lightning
import numpy as np
import torch
from numpy.typing import NDArray
from torch.utils.data import DataLoader

from sononerf import storage
from sononerf.acoustics.spectrogram import compress
from sononerf.config import Settings, validate_settings
from sononerf.data.range_slices import PoseReader, WholePoses
from sononerf.data.store import EnsembleStore
from sononerf.errors import IncompatibleError, InputError, SettingsError
from sononerf.experiment.build import field_and_renderer, module_for
from sononerf.experiment.fit import quiet_lightning, require_accelerator
from sononerf.experiment.run_folder import RunFolder
from sononerf.experiment.simulate import default_store
from sononerf.geometry.poses import Poses, read_pose_csv
from sononerf.module import EchoModule
from sononerf.progress import Progress
from sononerf.reconstruction.prediction import prediction_metrics
from sononerf.render.spectrogram import spectrogram_png
from sononerf.weights import DESCRIPTION_NAME, load_weights

Split = Literal["train", "val", "test"]


@dataclass(frozen=True)
class Fitted:
    """A fitted field as its run's two files describe it."""

    settings: Settings
    module: EchoModule
    echo_hash: str
    heard_from: torch.Tensor  # (P, 3) m, the training poses' heads


def load_fitted(path: Path) -> Fitted:
    """Read a fitted field from ``model.safetensors`` and ``model.json`` alone; runs no code.

    Raises
    ------
    InputError
        If they are missing or damaged.
    IncompatibleError
        If they do not fit together or need a newer version.
    """
    if not (path / DESCRIPTION_NAME).is_file():
        raise InputError(
            f"{path}: no fitted run (no {DESCRIPTION_NAME}); make or finish one with `sononerf fit`"
        )
    state, description = load_weights(path)
    try:
        settings = validate_settings(description["settings"], str(path / "model.json"))
        reference = float(description["reference"])
        echoes = str(description["echo_hash"])
        region = state["field.region"]
        heard_from = state["heard_from"]
    except (KeyError, TypeError, ValueError) as error:
        raise InputError(f"{path}: incomplete ({error}); repeat the fit") from None
    except SettingsError as error:
        raise IncompatibleError(f"settings of another version: {error}") from None
    field, renderer = field_and_renderer(settings, region)
    module = module_for(settings, field, renderer, reference=reference)
    for part, prefix in ((field, "field."), (renderer, "renderer.")):
        own = {k.removeprefix(prefix): v for k, v in state.items() if k.startswith(prefix)}
        try:
            part.load_state_dict(own)
        except RuntimeError as error:
            raise IncompatibleError(
                f"{path / 'model.safetensors'}: does not fit {settings.field.kind} and "
                f"{settings.renderer.kind} of this version: {str(error).splitlines()[-1].strip()}"
            ) from None
    module.eval()
    return Fitted(settings, module, echoes, heard_from)


def store_of(fitted: Fitted) -> EnsembleStore:
    """Open the ensemble that a field was fitted to.

    Raises
    ------
    InputError
        If it is not where the settings say.
    IncompatibleError
        If another one lies there.
    """
    settings = fitted.settings
    path = settings.data.store or default_store(settings, fitted.echo_hash)
    if not path.exists():
        raise InputError(
            f"{path}: the ensemble of this run is not there; make it again with "
            "`sononerf simulate RUN/config.yaml`, or predict poses of your own with --poses"
        )
    store = EnsembleStore.open(path)
    if store.attributes.get("echo_hash") != fitted.echo_hash:
        raise IncompatibleError(f"{path}: holds other echoes than those of this run")
    return store


def render_poses(
    fitted: Fitted, poses: WholePoses, *, accelerator: str = "auto", progress: Progress
) -> NDArray[np.float32]:
    """Render poses one by one, (P, E, R, F) linear magnitude."""
    quiet_lightning()
    require_accelerator(accelerator)
    rendered: list[NDArray[np.float32]] = []

    class Gather(lightning.Callback):
        def on_predict_batch_end(
            self,
            trainer: lightning.Trainer,
            pl_module: lightning.LightningModule,
            outputs: torch.Tensor,
            *rest: object,
        ) -> None:
            del trainer, pl_module, rest
            rendered.append(outputs.float().cpu().numpy())
            task.advance()

    with progress.task("predicting", len(poses)) as task:
        trainer = lightning.Trainer(
            accelerator=accelerator,
            devices=1,
            logger=False,
            callbacks=[Gather()],
            enable_checkpointing=False,
            enable_progress_bar=False,
            enable_model_summary=False,
        )
        trainer.predict(fitted.module, DataLoader(poses, batch_size=None), return_predictions=False)
    return np.concatenate(rendered)


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
    poses = _poses_to_render(store, own, split, renderer.range, renderer.frequency)
    storage.probe_writable(folder)
    magnitude = render_poses(fitted, poses, accelerator=accelerator, progress=progress)
    reference = fitted.module.reference
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
        run.write_metrics("prediction", _numbers(store, split, measured, predicted, reference))
    return folder


def _save_npz(file: BinaryIO, arrays: dict[str, NDArray[np.generic]]) -> None:
    buffer = io.BytesIO()
    np.savez_compressed(buffer, allow_pickle=False, **arrays)
    file.write(buffer.getbuffer())


def _poses_to_render(
    store: EnsembleStore | None,
    own: Poses | None,
    split: Split,
    ranges: torch.Tensor,
    frequencies: torch.Tensor,
) -> WholePoses:
    if own is not None:
        return WholePoses(
            torch.as_tensor(own.positions),
            torch.as_tensor(own.rotations),
            len(ranges),
            len(frequencies),
        )
    if store is None:
        raise InputError("neither an ensemble nor poses to predict")
    numbers = torch.as_tensor(store.indices(split))
    if not len(numbers):
        raise InputError(f"{store.path}: holds no {split} poses; choose another --split")
    return WholePoses(
        torch.as_tensor(store.positions)[numbers],
        torch.as_tensor(store.rotations)[numbers],
        len(ranges),
        len(frequencies),
        PoseReader(store, 1),
        numbers,
    )


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
