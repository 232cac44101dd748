# SPDX-License-Identifier: MIT
"""Settings into field, renderer and module."""

from __future__ import annotations

import math

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from sononerf.echoes.consistency import weighted
from sononerf.echoes.free_space import EchoHull
from sononerf.echoes.onsets import Onsets, PointEcho, find_onsets
from sononerf.echoes.region import WITNESS_GAIN, EchoRegion
from sononerf.echoes.store import EnsembleStore
from sononerf.errors import InputError, SettingsError
from sononerf.field.datamodule import EchoDataModule
from sononerf.field.field import Field
from sononerf.field.module import EchoModule
from sononerf.field.renderer import Acquisition, Possible, Renderer
from sononerf.head.air import absorption_in, speed_in
from sononerf.head.decibels import ACTIVE_DB
from sononerf.head.ears import analysed_ears, ear_tables
from sononerf.head.reception import effective_window
from sononerf.head.spectrogram import frequency_axis, range_axis
from sononerf.settings import plugins
from sononerf.settings.schema import Settings, faults_of


def _tensor(values: NDArray[np.floating]) -> Tensor:
    return torch.tensor(np.asarray(values), dtype=torch.float32)


def acquisition(settings: Settings) -> Acquisition:
    """Return what a renderer has to know of how the spectra came to be."""
    air, analysis = settings.air, settings.spectrogram
    speed = speed_in(air)
    frequency = frequency_axis(analysis)
    ears, lag = analysed_ears(settings.ears, settings.call, analysis)
    absorption = absorption_in(air, frequency)
    return Acquisition(
        frequency=_tensor(frequency),
        range=_tensor(range_axis(analysis, speed)),
        window=_tensor(effective_window(settings.call, analysis)),
        sampling_rate=analysis.sampling_rate,
        speed_of_sound=speed,
        absorption=_tensor(absorption) * (math.log(10.0) / 20.0),
        beam=_tensor(ears.beam),
        ears=_tensor(ears.ears),
        emitter=_tensor(ears.emitter),
        ear_positions=_tensor(ears.positions),
        lag=None if lag is None else _tensor(lag) * (speed / 2.0),
    )


def point_echo(settings: Settings) -> PointEcho:
    """Return what the analysis makes of the echo of one point."""
    return PointEcho.of(settings.call, settings.spectrogram, speed_in(settings.air))


def echo_hull(settings: Settings, store: EnsembleStore, heard: Onsets | None = None) -> EchoHull:
    """Return the space that the onsets of the asked poses leave, outliers of weight zero.

    Parameters
    ----------
    settings : Settings
        The experiment.
    store : EnsembleStore
        Its echoes.
    heard : Onsets or None
        What is detected in them; detected anew where None.
    """
    known, echo = acquisition(settings), point_echo(settings)
    heard = heard or find_onsets(store, echo)
    positions = np.asarray(store.positions, dtype=np.float64)[heard.poses]
    rotations = np.asarray(store.rotations, dtype=np.float64)[heard.poses]
    ears = known.ear_positions.double().numpy()
    hull = EchoHull(
        emitters=positions + rotations @ known.emitter.double().numpy(),
        receivers=positions[:, None] + np.einsum("pij,ej->pei", rotations, ears),
        first=heard.first - _mean_lag(known),
        axes=rotations[:, :, 0],
        within=_beam_cosine(known),
    )
    return weighted(hull, echo.resolution)


def _mean_lag(known: Acquisition) -> float:
    """Return how much farther off a sweep is heard on the mean over rows and directions, m.

    Each counts with its power. Rows that are nearly silent in a direction may lag by many times
    as much, but they have no part in the onset.
    """
    if known.lag is None:
        return 0.0
    elevation = torch.linspace(-math.pi / 2, math.pi / 2, known.beam.shape[1]).double()
    power = (known.beam * known.ears).double().square() * elevation.cos()[:, None]
    return float((power * known.lag).sum() / power.sum())


def _beam_cosine(known: Acquisition) -> float:
    """Return the cosine to the head's axis down to which a pose hears in every direction."""
    gain = (known.beam * known.ears.amax(dim=0)).amax(dim=0).double()
    gain /= gain.max()
    rows, columns = gain.shape
    elevation = torch.linspace(-math.pi / 2, math.pi / 2, rows).double()[:, None]
    azimuth = torch.linspace(-math.pi, math.pi, columns).double()
    ahead = elevation.cos() * azimuth.cos()
    deaf = ahead[gain < WITNESS_GAIN]
    return float(deaf.max()) if len(deaf) else -1.0


def echo_region(
    settings: Settings,
    store: EnsembleStore,
    hull: EchoHull | None = None,
    heard: Onsets | None = None,
) -> tuple[Tensor, Possible]:
    """Return the box that is fitted, from the settings or the echoes, and what is possible in it.

    Parameters
    ----------
    settings : Settings
        The experiment.
    store : EnsembleStore
        Its echoes.
    hull : EchoHull or None
        What the onsets leave; found anew where None.
    heard : Onsets or None
        What is detected in the echoes; detected anew where None.

    Returns
    -------
    region : (2, 3) float, m
        Lower and upper corner.
    possible : callable
        Which places the echoes leave possible, given how far a place speaks for its surroundings.
    """
    echo = point_echo(settings)
    heard = heard or find_onsets(store, echo)
    hull = hull or echo_hull(settings, store, heard)
    ears = ear_tables(settings.ears, frequency_axis(settings.spectrogram))
    rotations = np.asarray(store.rotations, dtype=np.float64)[heard.poses]
    found = EchoRegion(heard, hull, ears, rotations, echo.resolution)
    set_region = settings.region
    if set_region.lower is not None and set_region.upper is not None:
        box = np.asarray((set_region.lower, set_region.upper))
    else:
        box = found.box()

    def possible(places: Tensor, tolerance: float) -> Tensor:
        left = found.possible(places.double().cpu().numpy(), tolerance)
        if not left.any():
            left[:] = True  # the box is right by the user's word
        return torch.as_tensor(left, device=places.device)

    return _tensor(box), possible


def field_and_renderer(settings: Settings, region: Tensor) -> tuple[Field, Renderer]:
    """Return an unfitted field and its renderer.

    Raises
    ------
    SettingsError
        If a kind or an option is not known, or options do not go together.
    InputError
        If a plugin returns something else.
    """
    known = acquisition(settings)
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
        field = make_field(region, known.frequency, **field_options)
        renderer = make_renderer(region, known, **renderer_options)
    for made, kind, name in (
        (field, Field, settings.field.kind),
        (renderer, Renderer, settings.renderer.kind),
    ):
        if not isinstance(made, kind):
            raise InputError(
                f"{name!r} makes a {type(made).__name__}, expected a sononerf {kind.__name__}"
            )
    return field, renderer


def check_plugins(settings: Settings) -> None:
    """Refuse unknown kinds and options before anything expensive."""
    region = torch.tensor([[-0.05] * 3, [0.05] * 3])
    _, renderer = field_and_renderer(settings, region)
    if settings.fit.silent_share < 1.0 and renderer.whole_poses:
        with faults_of(settings.source):
            raise SettingsError(
                f"fit.silent_share: found {settings.fit.silent_share:g}, but renderer "
                f"{settings.renderer.kind!r} takes whole poses; lower fit.silent_weight instead, "
                "or take a renderer of single slices, such as shell"
            )


def data_for(settings: Settings, store: EnsembleStore, renderer: Renderer) -> EchoDataModule:
    """Return the LightningDataModule that streams an ensemble as a renderer wants it."""
    fit = settings.fit
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
    )


def module_for(
    settings: Settings,
    field: Field,
    renderer: Renderer,
    *,
    reference: float,
    possible: Possible | None = None,
    total_steps: int = 1,
    steps_per_epoch: int = 1,
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
        total_steps=total_steps,
        steps_per_epoch=steps_per_epoch,
        schedule=fit.schedule,
        final_rate_factor=fit.final_rate_factor,
        staircase_factor=fit.staircase_factor,
        staircase_epochs=fit.staircase_epochs,
        loss=fit.loss,
        silent_weight=fit.silent_weight,
        seed=fit.seed,
    )
