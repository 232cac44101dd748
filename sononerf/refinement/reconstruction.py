# SPDX-License-Identifier: MIT
"""From a fitted field and its echoes to a surface, and from that to a refined one."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager, suppress
from functools import partial
from typing import Any

import numpy as np
import torch
import trimesh
from lightning import Fabric

from sononerf.echoes.echoes import Echoes
from sononerf.errors import InputError, NumericalError, SettingsError, expect
from sononerf.field.fitting import quiet_lightning, usable_accelerator
from sononerf.field.module import EchoModule
from sononerf.field.read_out import energy_volume, read_isosurface
from sononerf.geometry.lattice import Volume
from sononerf.progress import Progress
from sononerf.refinement.descent import number_of_steps, poses_that_hear
from sononerf.refinement.optics import Optics
from sononerf.refinement.refine import Refinement, Saved
from sononerf.settings.loading import checked_section
from sononerf.settings.schema import ReconstructionSettings, SimulationSettings
from sononerf.simulation.simulator import Simulator
from sononerf.start.network import StartMethod, beyond_training, start_surfaces
from sononerf.start.surface import Surface, surface_as_heard

RAYS = 10_000
"""Rays per pose, for the correction of the last stage."""


def reconstruct(
    model: EchoModule | Echoes,
    echoes: Echoes | None = None,
    *,
    options: ReconstructionSettings | Mapping[str, Any] | None = None,
    progress: Progress | None = None,
) -> Surface:
    """Read a surface out of echoes; :func:`refine` improves it.

    A network makes the surface of the echoes, and the field gives the volume. With the method
    ``isosurface`` the surface is a level of the field's volume.

    Args:
        model: Fitted to the echoes; or the echoes alone.
        echoes: The fitted echoes; an iso-surface needs none.
        options: Keys of the section ``reconstruction`` of the settings, such as ``{"spacing":
            0.002}`` or ``{"method": "isosurface", "level": 0.5}``.
        progress: Display of progress; on stderr by default.

    Returns:
        surface: Not refined.

    Raises:
        SettingsError: If an option is not allowed, or the spacing is larger than the region.
        NumericalError: If there is no surface.
    """
    progress = progress or Progress()
    chosen = checked_section(ReconstructionSettings, options or {}, "reconstruction")
    if isinstance(model, Echoes):
        if chosen.method == "isosurface":
            raise SettingsError(
                "method isosurface needs a fitted model; give one, or take the method levels"
            )
        return _of_echoes(model, progress)
    expect(model, EchoModule, "model")
    keywords: dict[str, Any] = {"spacing": chosen.spacing, "directions": chosen.directions}

    def of_field() -> tuple[trimesh.Trimesh, Volume, float]:
        with _shown(progress) as shown:
            smoothing = chosen.smoothing
            return read_isosurface(
                model.field, level=chosen.level, smoothing=smoothing, progress=shown, **keywords
            )

    if chosen.method == "isosurface":
        mesh, volume, level = of_field()
        return Surface(mesh, volume, "isosurface", level=level, echoes=echoes)
    if echoes is None:
        raise InputError("echoes: missing; give the echoes that the model was fitted to")
    with _shown(progress) as shown:
        volume = energy_volume(model.field, **keywords, progress=shown)
    return _of_echoes(echoes, progress, volume, lambda: of_field()[0])


def _of_echoes(
    echoes: Echoes,
    progress: Progress,
    volume: Volume | None = None,
    of_field: Callable[[], trimesh.Trimesh] | None = None,
) -> Surface:
    """Return the surface that the network makes of echoes.

    Where the echoes are unlike those of its training, an iso-surface of the field is a start too.
    """
    starts = start_surfaces(echoes.levels, echoes.hull, echoes.bounds, echoes.head.resolution)
    mesh = starts["levels"]
    support = echoes.hull.plane is not None
    if doubt := beyond_training(echoes.levels, np.asarray(mesh.bounds), support=support):
        if of_field is None:
            progress.say(f"{doubt}; its surface is taken all the same, and is a guess")
        else:
            progress.say(f"{doubt}; an iso-surface of the field is refined beside its surface")
            with suppress(NumericalError):
                starts["isosurface"] = of_field()
    with _one_thread():
        heard = poses_that_hear(mesh, echoes, Optics(echoes.head))
    surface = surface_as_heard(
        mesh,
        echoes,
        volume=volume,
        method="levels",
        confidence=heard.cpu().numpy().astype(np.int32),
        starts=starts,
    )
    if surface.openness is not None and surface.openness.text:
        progress.say(surface.openness.text)
    return surface


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

    A surface of :func:`reconstruct` is refined in several ways, and the one that explains the
    validation poses best is taken. One of your own is refined as it is.

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
        surface: The one that explains the validation poses best.

    Raises:
        SettingsError: If an option is not allowed, or the surface is an iso-surface.
        ResourceError: If ``accelerator`` is ``gpu`` and there is none.
    """
    progress = progress or Progress()
    expect(surface, Surface, "surface")
    expect(echoes, Echoes, "echoes")
    accelerator = usable_accelerator(accelerator)
    simulation = checked_section(SimulationSettings, options or {}, "simulation")
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
    facts: dict[str, Any] = {
        "method": refined.start,
        "confidence": refined.confidence.round().astype(np.int32),
        "error": refined.error.astype(np.float32) if has_error else None,
        "refined": True,
        "error_db": refined.error_db if has_error else None,
        "faults": refined.faults,
        "volume": surface.volume,
        "starts": surface.starts,
    }
    if surface.method == "given":
        return Surface(refined.mesh, echoes=echoes, **facts)
    return surface_as_heard(refined.mesh, echoes, **facts)


def starts_of(surface: Surface) -> dict[StartMethod, trimesh.Trimesh]:
    """Return the start surfaces of a refinement, m, by their method."""
    if surface.method == "isosurface" and not surface.starts:
        raise SettingsError(
            "an iso-surface is not refined; reconstruct with the method levels, or give "
            "Surface(mesh) to refine its mesh"
        )
    return dict(surface.starts) or {"given": surface.mesh}


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
