# SPDX-License-Identifier: MIT
"""Settings into what is fitted: region, field, renderer, and Lightning's module and data."""

from __future__ import annotations

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from sononerf.echoes.echoes import Echoes
from sononerf.echoes.memory_ensemble import Ensemble
from sononerf.errors import InputError, SettingsError
from sononerf.field.datamodule import EchoDataModule
from sononerf.field.field import Field
from sononerf.field.module import EchoModule
from sononerf.field.renderer import Possible, Renderer
from sononerf.head.decibels import ACTIVE_DB
from sononerf.head.head import Head
from sononerf.settings import plugins
from sononerf.settings.loading import faults_of
from sononerf.settings.schema import Settings


def region_of(settings: Settings, echoes: Echoes) -> tuple[Tensor, Possible]:
    """Return the box that is fitted, from the settings or the echoes, and what is possible in it.

    Returns:
        region ((2, 3), m): Lower and upper corner.
        possible: Which places the echoes leave possible, given how far a place speaks for its
            surroundings.

    Raises:
        NumericalError: If no pose heard anything, or no more than noise gives.
    """
    found, wanted = echoes.region, settings.region
    if wanted.lower is not None and wanted.upper is not None:
        box = np.asarray((wanted.lower, wanted.upper))
    else:
        box = found.box()

    def possible(places: Tensor, tolerance: float) -> Tensor:
        left = found.possible(places.cpu().double().numpy(), tolerance)
        if not left.any():
            left[:] = True  # the user's own box is kept whole
        return torch.as_tensor(left, device=places.device)

    return _tensor(box), possible


def field_and_renderer(settings: Settings, head: Head, region: Tensor) -> tuple[Field, Renderer]:
    """Return an unfitted field and its renderer.

    Raises:
        SettingsError: If a kind or an option is not known, or options do not go together.
        InputError: If a plugin returns something else.
    """
    with faults_of(settings.source):
        make_field = plugins.load(plugins.FIELDS, settings.field.kind)
        field_options = plugins.check_options(
            make_field, settings.field.options, where="field.options", given=2
        )
        make_renderer = plugins.load(plugins.RENDERERS, settings.renderer.kind)
        renderer_options = plugins.check_options(
            make_renderer, settings.renderer.options, where="renderer.options", given=2
        )
        torch.manual_seed(settings.fit.seed)
        field = make_field(region, _tensor(head.frequency), **field_options)
        renderer = make_renderer(region, head, **renderer_options)
    for made, kind, name in (
        (field, Field, settings.field.kind),
        (renderer, Renderer, settings.renderer.kind),
    ):
        if not isinstance(made, kind):
            raise InputError(
                f"{name!r} makes a {type(made).__name__}, expected a sononerf {kind.__name__}"
            )
    return field, renderer


def check_plugins(settings: Settings, head: Head) -> None:
    """Refuse unknown kinds and options before anything expensive."""
    region = torch.tensor([[-0.05] * 3, [0.05] * 3])
    _, renderer = field_and_renderer(settings, head, region)
    if settings.fit.silent_share < 1.0 and renderer.whole_poses:
        with faults_of(settings.source):
            raise SettingsError(
                f"fit.silent_share: found {settings.fit.silent_share:g}, but renderer "
                f"{settings.renderer.kind!r} takes whole poses; lower fit.silent_weight instead, "
                "or take a renderer of single slices, such as shell"
            )


def data_for(settings: Settings, store: Ensemble, renderer: Renderer) -> EchoDataModule:
    """Return the LightningDataModule that streams an ensemble as a renderer wants it."""
    fit = settings.fit
    steps = None if fit.steps_per_epoch == "auto" else fit.steps_per_epoch
    return EchoDataModule(
        store,
        whole_poses=renderer.whole_poses,
        batch=fit.batch_poses if renderer.whole_poses else fit.batch_slices,
        batch_frequencies=None if fit.batch_frequencies == "all" else fit.batch_frequencies,
        seed=fit.seed,
        workers=settings.data.workers,
        memory_bytes=settings.data.memory_bytes,
        silent_share=fit.silent_share,
        silent_below=float(store.attributes["reference"]) * (10 ** (ACTIVE_DB / 20) - 1),
        steps_per_epoch=steps,
    )


def module_for(
    settings: Settings,
    field: Field,
    renderer: Renderer,
    *,
    reference: float,
    possible: Possible | None = None,
) -> EchoModule:
    """Return the LightningModule around field and renderer."""
    fit = settings.fit
    return EchoModule(
        field,
        renderer,
        reference=reference,
        dynamic_range_db=settings.spectrogram.dynamic_range_db,
        early_range_db=fit.early_range_db,
        early_share=fit.early_share,
        possible=possible,
        learning_rate=fit.learning_rate or field.learning_rate,
        schedule=fit.schedule,
        final_rate_factor=fit.final_rate_factor,
        staircase_factor=fit.staircase_factor,
        staircase_epochs=fit.staircase_epochs,
        loss=fit.loss,
        silent_weight=fit.silent_weight,
        seed=fit.seed,
    )


def _tensor(values: NDArray[np.floating]) -> Tensor:
    return torch.tensor(np.asarray(values), dtype=torch.float32)
