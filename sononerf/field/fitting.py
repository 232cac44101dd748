# SPDX-License-Identifier: MIT
"""Fit a field to echoes, and render poses with the fitted field; both through Lightning."""

from __future__ import annotations

import copy
import logging
import time
import warnings
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import lightning
import numpy as np
import torch
from lightning.fabric.utilities.exceptions import MisconfigurationException
from lightning.pytorch.loggers import Logger
from torch import Tensor

from sononerf.echoes.echoes import Echoes
from sononerf.errors import NumericalError, ResourceError, SettingsError
from sononerf.field.checkpoint_io import DurableCheckpointIO
from sononerf.field.datamodule import EchoDataModule, RangeSlices, WholePoses, one_by_one
from sononerf.field.module import EchoModule
from sononerf.geometry.poses import Poses
from sononerf.numerics import Singles
from sononerf.progress import Progress
from sononerf.settings.schema import FitSettings

STATES = 4
"""Numbers kept per parameter, no unit: its value, its gradient, and Adam's two averages."""
WORKSPACE = 2.0
"""Memory of a backward pass over the memory of the values it needs, no unit: gradients are as large
as values."""


@dataclass(frozen=True)
class StepCost:
    """Cost of one training step."""

    memory: float  # Bytes of parameters and of the backward pass's values
    seconds: float  # Duration on this machine's CPU


def step_cost(module: EchoModule, data: EchoDataModule) -> StepCost:
    """Measure one item of a batch, and scale it to the whole batch.

    The module's random numbers, parameters and buffers stay as they are; a copy is used.
    """
    batch = data.stream()[0]
    part = RangeSlices(
        batch.pose[:1],
        batch.position[:1],
        batch.rotation[:1],
        batch.rows[:1],
        batch.bins,
        batch.spectrum[:1],
    )
    trial = copy.deepcopy(module)
    parameters = [each for each in trial.parameters() if each.requires_grad]
    sizes: dict[int, int] = {}

    def count(values: Tensor) -> Tensor:
        storage = values.untyped_storage()
        sizes[storage.data_ptr()] = storage.nbytes()
        return values

    seconds = 0.0
    with torch.random.fork_rng([]):
        trial.field.advance(0, 1)
        trial.renderer.advance(0, 1)
        trial.renderer.prepare(trial.field, trial.possible, 0)
        for _ in range(2):  # the first pass includes compiling
            sizes.clear()
            begun = time.monotonic()
            with torch.autograd.graph.saved_tensors_hooks(count, lambda values: values):
                predicted = trial(part)
            torch.autograd.grad(predicted.sum(), parameters, allow_unused=True)
            seconds = time.monotonic() - begun
    own = {each.untyped_storage().data_ptr() for each in parameters}
    saved = sum(size for place, size in sizes.items() if place not in own)
    fixed = STATES * sum(each.numel() * each.element_size() for each in parameters)
    items = len(batch.pose)
    return StepCost(fixed + WORKSPACE * items * saved, items * seconds)


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


def usable_accelerator(accelerator: str) -> str:
    """Return the accelerator for Lightning: for ``auto`` the CPU where there is no CUDA.

    Apple's GPU has no double precision, which fields need. Raises :class:`ResourceError` for
    ``gpu`` without CUDA.
    """
    there = torch.cuda.is_available()
    if accelerator == "gpu" and not there:
        raise ResourceError(
            "no GPU with double precision that torch can use; take --accelerator cpu, or auto"
        )
    return "cpu" if accelerator == "auto" and not there else accelerator


def make_trainer(**options: Any) -> lightning.Trainer:
    """Return a Trainer of Lightning, whose options are those of its constructor.

    Raises:
        SettingsError: If Lightning refuses an option, with its words.
    """
    quiet_lightning()
    try:
        return lightning.Trainer(**options)
    except (ValueError, MisconfigurationException) as error:
        raise SettingsError(f"Lightning: {' '.join(str(error).split())}") from None


def fit(
    echoes: Echoes,
    model: EchoModule | None = None,
    data: EchoDataModule | None = None,
    *,
    options: FitSettings | Mapping[str, Any] | None = None,
    callbacks: Sequence[lightning.Callback] = (),
    logger: Logger | None = None,
    folder: Path | None = None,
    checkpoint: Path | None = None,
    accelerator: str = "auto",
    devices: int | str = "auto",
    num_nodes: int = 1,
    precision: str = "32-true",
    strategy: str = "auto",
) -> EchoModule:
    """Fit a module to echoes and validate after each epoch, as the command ``fit`` does.

    Your own Trainer works as well: ``trainer.fit(model, EchoDataModule(echoes))``.

    Args:
        echoes: The echoes to fit.
        model: Field and renderer; a default one for these echoes by default.
        data: Streams the echoes; with the module's options by default.
        options: Options of the fit: keys of the section ``fit`` of the settings, such as
            ``{"epochs": 40}``; of a model that is given, its own.
        callbacks: Lightning callbacks.
        logger: Logger of scalars and pictures.
        folder: Default folder of Lightning and its callbacks.
        checkpoint: Checkpoint that the fit resumes; None starts anew.
        accelerator, devices, num_nodes, precision, strategy: As of Lightning's Trainer.

    Returns:
        model: Fitted.

    Raises:
        SettingsError: If an option is not allowed, or options are given beside a model, or
            Lightning refuses precision or strategy.
        NumericalError: If a gradient or a parameter is not finite.
        ResourceError: If ``accelerator`` is ``gpu`` and there is none.
    """
    accelerator = usable_accelerator(accelerator)
    if model is None:
        model = EchoModule.for_echoes(echoes, options=options)
    elif options is not None:
        raise SettingsError("options: the model has its own; give them to EchoModule.for_echoes")
    trainer = make_trainer(
        accelerator=accelerator,
        devices=devices,
        num_nodes=num_nodes,
        precision=precision,
        strategy=strategy,
        max_epochs=model.options.epochs,
        max_steps=model.options.max_steps or -1,
        limit_val_batches=1.0 if len(echoes.store.indices("val")) else 0,
        num_sanity_val_steps=0,
        gradient_clip_val=model.options.gradient_clip,
        logger=logger or False,
        callbacks=list(callbacks),
        plugins=[DurableCheckpointIO()],
        enable_checkpointing=False,
        enable_progress_bar=False,
        enable_model_summary=False,
        use_distributed_sampler=False,
        log_every_n_steps=5,
        default_root_dir=folder,
    )
    trainer.fit(model, data or EchoDataModule(echoes), ckpt_path=checkpoint, weights_only=True)
    bad = [n for n, p in model.named_parameters() if not bool(p.isfinite().all())]
    if bad:
        raise NumericalError(f"the fitted {bad[0]} is not finite; lower fit.learning_rate")
    return model


def render_poses(
    model: EchoModule, poses: Poses, *, accelerator: str = "auto", progress: Progress
) -> Singles:
    """Render poses one by one with a fitted model, (P, E, R, F) linear magnitude."""
    whole = WholePoses(
        torch.as_tensor(poses.positions),
        torch.as_tensor(poses.rotations),
        len(model.renderer.range),
        len(model.renderer.frequency),
    )
    quiet_lightning()
    accelerator = usable_accelerator(accelerator)
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
        trainer.predict(model, one_by_one(whole), return_predictions=False)
    return np.concatenate(rendered)
