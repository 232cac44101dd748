# SPDX-License-Identifier: MIT
"""A fitted run: what it was fitted with, and what it renders."""

from __future__ import annotations

import math
from dataclasses import dataclass, fields
from pathlib import Path
from typing import Any, Literal

import lightning
import numpy as np
import torch
from numpy.typing import NDArray
from torch.utils.data import DataLoader

from sononerf.echoes.free_space import EchoHull
from sononerf.echoes.store import EnsembleStore
from sononerf.errors import IncompatibleError, InputError, SettingsError
from sononerf.field.module import EchoModule
from sononerf.field.range_slices import PoseReader, WholePoses
from sononerf.field.renderer import Renderer
from sononerf.field.weights import DESCRIPTION_NAME, load_weights
from sononerf.geometry.poses import Poses
from sononerf.head.head import Head
from sononerf.progress import Progress
from sononerf.run.attached import with_attached
from sononerf.run.build import field_and_renderer, head_of, module_for
from sononerf.run.fit import quiet_lightning, require_accelerator
from sononerf.run.simulate import default_store, open_ensemble
from sononerf.settings.loading import validate_settings
from sononerf.settings.schema import Settings
from sononerf.simulation.pose_sets import ensemble_poses

Split = Literal["train", "val", "test"]


@dataclass(frozen=True)
class Fitted:
    """A fitted field as its run's two files describe it."""

    settings: Settings
    head: Head
    module: EchoModule
    echo_hash: str
    hull: EchoHull  # where the training poses were, and what their first echoes leave


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
        hull = _hull(state)
    except (KeyError, TypeError, ValueError) as error:
        raise InputError(f"{path}: incomplete ({error}); repeat the fit") from None
    except SettingsError as error:
        raise IncompatibleError(f"settings of another version: {error}") from None
    if not 0.0 < reference < math.inf:  # JSON as Python reads it knows NaN
        raise InputError(
            f"{path / DESCRIPTION_NAME}: reference is {reference}, expected a finite number above "
            "0; fetch the run again, or repeat the fit with --overwrite"
        )
    settings = with_attached(settings, path)
    head = head_of(settings)
    field, renderer = field_and_renderer(settings, head, region)
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
    return Fitted(settings, head, module, echoes, hull)


def _hull(state: dict[str, torch.Tensor]) -> EchoHull:
    read: dict[str, Any] = {
        f.name: state[f"hull.{f.name}"].double().numpy() for f in fields(EchoHull)
    }
    return EchoHull(**{**read, "within": float(read["within"])})


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
        again = (
            "import the recordings again"
            if settings.scene is None
            else "make it again with `sononerf simulate RUN/config.yaml`"
        )
        raise InputError(
            f"{path}: the ensemble of this run is not there; {again}, or predict poses of your "
            "own with --poses"
        )
    store = open_ensemble(settings, path)
    if store.attributes.get("echo_hash") != fitted.echo_hash:
        raise IncompatibleError(f"{path}: holds other echoes than those of this run")
    return store


def has_heldout(fitted: Fitted) -> bool:
    """Tell whether poses were held out of the fit."""
    if fitted.settings.scene is not None:
        return fitted.settings.poses.heldout > 0
    return len(store_of(fitted).indices("test")) > 0


def all_poses(fitted: Fitted) -> tuple[Poses, NDArray[np.int8]]:
    """Return the poses of a run's ensemble and what each is for (P,): 0 train, 1 val, 2 test."""
    if fitted.settings.scene is not None:
        return ensemble_poses(fitted.settings.poses)
    store = store_of(fitted)
    return Poses(store.positions, store.rotations), store.split


def poses_of(store: EnsembleStore, split: Split, renderer: Renderer) -> WholePoses:
    """Return the poses of a split, one by one, with what was measured there."""
    numbers = torch.as_tensor(store.indices(split))
    return WholePoses(
        torch.as_tensor(store.positions)[numbers],
        torch.as_tensor(store.rotations)[numbers],
        len(renderer.range),
        len(renderer.frequency),
        PoseReader(store, 1),
        numbers,
    )


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
