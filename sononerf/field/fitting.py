# SPDX-License-Identifier: MIT
"""Fit a field to echoes, and render poses with the fitted field; both through Lightning."""

from __future__ import annotations

import logging
import warnings
from dataclasses import dataclass
from pathlib import Path

import lightning
import numpy as np
import torch
from lightning.pytorch.loggers import Logger
from torch.utils.data import DataLoader

from sononerf.array_types import Singles
from sononerf.echoes.echoes import Echoes, Split
from sononerf.echoes.free_space import EchoHull
from sononerf.errors import NumericalError, ResourceError
from sononerf.field.checkpoint_io import DurableCheckpointIO
from sononerf.field.datamodule import EchoDataModule, PoseReader, WholePoses
from sononerf.field.module import EchoModule
from sononerf.field.renderer import Renderer
from sononerf.head.head import Head
from sononerf.progress import Progress


@dataclass(frozen=True)
class FittedField:
    """A fitted field with the head that it was heard with.

    Attributes:
        module: Field and renderer.
        head: What heard the echoes.
        hull: Free space in front of the onsets of the training poses.
    """

    module: EchoModule
    head: Head
    hull: EchoHull


def quiet_lightning() -> None:
    """Silence Lightning's tips and the warnings about settings that are chosen on purpose."""
    for name in ("lightning.pytorch", "lightning.fabric"):
        logging.getLogger(name).setLevel(logging.WARNING)
    for name in ("lightning.pytorch.utilities.rank_zero", "lightning.fabric.utilities.rank_zero"):
        logging.getLogger(name).setLevel(logging.ERROR)
    for pattern in (
        r".*does not have many workers.*",  # the ensemble lies in memory
        r".*is smaller than the logging interval.*",  # short epochs still log their last step
        r".*GPU available but not used.*",  # the user chose
        r".*\.*Checkpoint directory .* exists and is not empty.*",
        r".*treespec, LeafSpec.* is deprecated.*",  # Lightning's own call of torch
    ):
        warnings.filterwarnings("ignore", message=pattern)


def require_accelerator(accelerator: str) -> None:
    """Refuse a GPU that is not there.

    Raises:
        ResourceError: If ``gpu`` was asked for and there is none.
    """
    if accelerator == "gpu" and not (
        torch.cuda.is_available() or torch.backends.mps.is_available()
    ):
        raise ResourceError("no GPU that torch can use; take --accelerator cpu, or auto")


def fit(
    echoes: Echoes,
    module: EchoModule,
    data: EchoDataModule,
    *,
    callbacks: list[lightning.Callback],
    gradient_clip: float | None,
    max_epochs: int,
    max_steps: int | None = None,
    logger: Logger | None = None,
    folder: Path | None = None,
    checkpoint: Path | None = None,
    accelerator: str = "auto",
    devices: int | str = "auto",
    num_nodes: int = 1,
) -> FittedField:
    """Fit a module to echoes; validate after each epoch.

    Args:
        echoes: What is fitted to.
        module: Field and renderer.
        data: Streams the echoes.
        callbacks: What happens around the fit.
        gradient_clip: Largest norm of a gradient; not limited where None.
        max_epochs, max_steps: The fit ends at the smaller of both.
        logger: Where scalars and pictures go.
        folder: Where Lightning and its callbacks write by default.
        checkpoint: Where the fit goes on; from the beginning where None.
        accelerator, devices, num_nodes: As of Lightning's Trainer.

    Raises:
        NumericalError: If a parameter is not finite at the end.
    """
    quiet_lightning()
    trainer = lightning.Trainer(
        accelerator=accelerator,
        devices=devices,
        num_nodes=num_nodes,
        max_epochs=max_epochs,
        max_steps=max_steps or -1,
        limit_val_batches=1.0 if len(echoes.store.indices("val")) else 0,
        num_sanity_val_steps=0,
        gradient_clip_val=gradient_clip,
        logger=logger or False,
        callbacks=callbacks,
        plugins=[DurableCheckpointIO()],
        enable_checkpointing=False,
        enable_progress_bar=False,
        enable_model_summary=False,
        use_distributed_sampler=False,
        log_every_n_steps=5,
        default_root_dir=folder,
    )
    trainer.fit(module, data, ckpt_path=checkpoint, weights_only=True)
    bad = [n for n, p in module.named_parameters() if not bool(p.isfinite().all())]
    if bad:
        raise NumericalError(f"the fitted {bad[0]} is not finite; lower fit.learning_rate")
    return FittedField(module, echoes.head, echoes.hull)


def poses_of(echoes: Echoes, split: Split, renderer: Renderer) -> WholePoses:
    """Return the poses of a split, one by one, with what was measured there."""
    numbers = torch.as_tensor(echoes.store.indices(split))
    return WholePoses(
        torch.as_tensor(echoes.positions)[numbers],
        torch.as_tensor(echoes.rotations)[numbers],
        len(renderer.range),
        len(renderer.frequency),
        PoseReader(echoes.store, 1),
        numbers,
    )


def render_poses(
    fitted: FittedField, poses: WholePoses, *, accelerator: str = "auto", progress: Progress
) -> Singles:
    """Render poses one by one, (P, E, R, F) linear magnitude."""
    quiet_lightning()
    require_accelerator(accelerator)
    rendered: list[Singles] = []

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
