# SPDX-License-Identifier: MIT
"""From a fitted field and its echoes to a surface, and from that to a refined one."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager, nullcontext
from dataclasses import replace
from functools import partial
from typing import Any, overload

import numpy as np
import torch
import trimesh
from lightning import Fabric

from sononerf.echoes.echoes import Echoes
from sononerf.echoes.free_space import EchoHull
from sononerf.errors import InputError, SettingsError, expect
from sononerf.field.fitting import quiet_lightning, usable_accelerator
from sononerf.field.module import EchoModule
from sononerf.progress import Progress
from sononerf.refinement.descent import number_of_steps, poses_that_hear
from sononerf.refinement.optics import Optics
from sononerf.refinement.refine import Refinement, Saved
from sononerf.settings.loading import checked_section
from sononerf.settings.schema import ReconstructionSettings, SimulationSettings
from sononerf.simulation.simulator import Simulator
from sononerf.start.read_out import (
    LEVELS,
    StartMethod,
    read_echoes,
    read_field,
    read_isosurface,
    start_surfaces,
)
from sononerf.start.surface import Surface, finished_surface

UNREFINED: tuple[StartMethod, ...] = ("filled", "hull", "open", "sheet")
"""Start methods in order: without refinement the first that gives a surface is taken."""
RAYS = 10_000
"""Rays per pose, for the correction of the last stage."""


@overload
def reconstruct(
    model: EchoModule,
    echoes: Echoes | EchoHull,
    *,
    options: ReconstructionSettings | Mapping[str, Any] | None = None,
    progress: Progress | None = None,
) -> Surface: ...


@overload
def reconstruct(
    model: Echoes,
    *,
    options: ReconstructionSettings | Mapping[str, Any] | None = None,
    progress: Progress | None = None,
) -> Surface: ...


def reconstruct(
    model: EchoModule | Echoes,
    echoes: Echoes | EchoHull | None = None,
    *,
    options: ReconstructionSettings | Mapping[str, Any] | None = None,
    progress: Progress | None = None,
) -> Surface:
    """Read a surface out of echoes, with or without a field; :func:`refine` improves it.

    Args:
        model: Fitted to the echoes; or the echoes alone, from which a network makes the surface.
        echoes: The fitted echoes, or their free space.
        options: Keys of the section ``reconstruction`` of the settings, such as ``{"spacing":
            0.002, "method": "hull"}`` or ``{"method": "isosurface", "level": 0.5}``.
        progress: Display of progress; on stderr by default.

    Returns:
        surface: Not refined.

    Raises:
        SettingsError: If an option is not allowed, or the spacing is larger than the region.
        NumericalError: If the field has no surface.
    """
    progress = progress or Progress()
    chosen = checked_section(ReconstructionSettings, options or {}, "reconstruction")
    if isinstance(model, Echoes):
        return _without_field(model, chosen, progress)
    expect(model, EchoModule, "model")
    if echoes is None:
        raise InputError("echoes: missing; give the echoes that the model was fitted to")
    hull = echoes if isinstance(echoes, EchoHull) else echoes.hull
    heard = None if isinstance(echoes, EchoHull) else echoes
    field = model.field
    if chosen.level != "auto" or chosen.method == "isosurface":
        with _shown(progress) as shown:
            mesh, volume, level = read_isosurface(
                field,
                spacing=chosen.spacing,
                level=chosen.level,
                directions=chosen.directions,
                smoothing=chosen.smoothing,
                progress=shown,
            )
        return Surface(mesh, volume, "isosurface", level=level, echoes=heard)
    with _shown(progress) as shown, nullcontext() if field.costly else _one_thread():
        reading = read_field(
            field,
            hull,
            resolution=_resolution(model, heard),
            spacing=chosen.spacing,
            directions=chosen.directions,
            levels=None if heard is None else heard.levels,
            progress=shown,
        )
    methods = UNREFINED if chosen.method == "auto" else (chosen.method,)
    method, mesh = next(start_surfaces(reading, methods))
    if chosen.method != "auto":
        reading = replace(reading, methods=LEVELS if method == "levels" else methods)
    return finished_surface(mesh, method, reading, echoes=heard)


def _without_field(echoes: Echoes, options: ReconstructionSettings, progress: Progress) -> Surface:
    """Return the surface that the network makes of echoes."""
    if options.method not in ("auto", "levels"):
        raise SettingsError(
            f"method {options.method} needs a fitted model; give one, or take the method levels"
        )
    reading = read_echoes(echoes)
    with _one_thread():
        method, mesh = next(start_surfaces(reading, ("levels",)))
        heard = poses_that_hear(mesh, echoes, Optics(echoes.head))
    count = heard.cpu().numpy().astype(np.int32)
    surface = finished_surface(mesh, method, reading, echoes=echoes, confidence=count)
    if surface.openness is not None and surface.openness.text:
        progress.say(surface.openness.text)
    return surface


def _resolution(model: EchoModule, echoes: Echoes | None) -> float:
    head = model.head if echoes is None else echoes.head
    if head is None:
        raise SettingsError("the model knows no head; give the echoes that it was fitted to")
    return head.resolution


def refine(
    surface: Surface,
    echoes: Echoes,
    *,
    options: SimulationSettings | Mapping[str, Any] | None = None,
    seed: int = 0,
    accelerator: str = "auto",
    saved: Saved | None = None,
    after_stage: Callable[[trimesh.Trimesh, float], None] | None = None,
    progress: Progress | None = None,
) -> Surface:
    """Move a surface until physical optics, corrected by the simulator, gives the echoes.

    Of a surface that :func:`reconstruct` read out of a field, all start surfaces are tried, and the
    one that explains the validation poses best after its refinement is taken. One of a method that
    was asked for, one without a field and one of your own are refined as they are.

    Args:
        surface: The start.
        echoes: Measured echoes; the surface is fitted to the training poses and compared on the
            validation poses.
        options: Options of the simulator that corrects: keys of the section ``simulation`` of the
            settings.
        seed: Order of the poses.
        accelerator: Device to compute on: ``auto``, ``cpu`` or ``gpu``.
        saved: Stages that are done are kept here. Given again with the same surface and echoes,
            they are not repeated.
        after_stage: Called with the surface of a stage and its error on validation poses, dB.
        progress: Display of progress; on stderr by default.

    Returns:
        surface: The best one; the start where all refined ones explain the validation poses clearly
            worse.

    Raises:
        SettingsError: If an option is not allowed, or the surface is an iso-surface.
        ResourceError: If ``accelerator`` is ``gpu`` and there is none.
    """
    progress = progress or Progress()
    expect(surface, Surface, "surface")
    expect(echoes, Echoes, "echoes")
    accelerator = usable_accelerator(accelerator)
    simulation = checked_section(SimulationSettings, options or {}, "simulation")
    reading = surface.reading
    starts = starts_of(surface)
    with progress.task("refining", number_of_steps(starts)) as task, _one_thread():

        def after_step(steps: int, mismatch: float) -> None:
            task.advance(steps, f"mismatch {mismatch:.2f} dB")

        refined = Refinement(
            starts,
            echoes,
            _placed(Optics(echoes.head), accelerator),
            simulate=partial(Simulator.of_surface, head=echoes.head, options=simulation, rays=RAYS),
            seed=seed,
            saved=saved,
            after_step=after_step,
            after_stage=after_stage,
        ).run()
    has_error = math.isfinite(refined.error_db)
    return finished_surface(
        refined.mesh,
        refined.start,
        reading,
        echoes=echoes,
        confidence=refined.confidence.round().astype(np.int32),
        error=refined.error.astype(np.float32) if has_error else None,
        refined=refined.kept,
        error_db=refined.error_db if has_error else None,
        faults=refined.faults,
        candidates=refined.candidates,
    )


def starts_of(surface: Surface) -> dict[StartMethod, trimesh.Trimesh]:
    """Return the start surfaces of a refinement, m, by their method."""
    if surface.method == "isosurface":
        raise SettingsError(
            "an iso-surface is not refined; reconstruct with the method auto, or give "
            "Surface(mesh) to refine its mesh"
        )
    if surface.reading is None:
        return {surface.method: surface.mesh}
    return dict(start_surfaces(surface.reading, surface.reading.methods))


def _placed(optics: Optics, accelerator: str) -> Optics:
    """Return the optics on the device of an accelerator."""
    quiet_lightning()
    Fabric(accelerator=accelerator, devices=1).to_device(optics)
    return optics


@contextmanager
def _one_thread() -> Iterator[None]:
    """Let torch compute in one thread, so that results do not depend on the number of cores.

    On two idle cores a second one saves up to a tenth of the time. Beside two busy processes a step
    takes 2.4 times as long with two: threads wait for each other.
    """
    before = torch.get_num_threads()
    torch.set_num_threads(1)
    try:
        yield
    finally:
        torch.set_num_threads(before)


@contextmanager
def _shown(progress: Progress) -> Iterator[Callable[[int, int], None]]:
    """Show the progress of the read-out."""
    with progress.task("reconstructing", 1000) as task, torch.inference_mode():
        yield lambda done, total: task.advance(1000 * done // total - task.done)
