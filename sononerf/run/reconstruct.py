# SPDX-License-Identifier: MIT
"""Reconstruct a run's surface: read start surfaces out of the field, and refine the best."""

from __future__ import annotations

import hashlib
import logging
import math
import time
from pathlib import Path
from typing import Literal

import numpy as np
import safetensors.torch
import trimesh
from safetensors import SafetensorError, safe_open
from torch import Tensor

from sononerf import storage
from sononerf.callbacks.tensorboard import add_mesh, writing
from sononerf.errors import IncompatibleError, InputError, SettingsError
from sononerf.field.checkpoint_io import model_checksum
from sononerf.geometry.frame import Frame
from sononerf.progress import Progress
from sononerf.report.pictures.mesh_picture import confidence_png, mesh_png, side_by_side_png
from sononerf.report.pictures.mip_picture import mip_pictures
from sononerf.run.build import results_folder, true_mesh
from sononerf.run.run_folder import RunFolder
from sononerf.surface import reconstruction
from sononerf.surface.mesh_files import mesh_bytes
from sononerf.surface.reconstruction import refine, starts_of
from sononerf.surface.refine import descent as stages
from sononerf.surface.refine.refinement import STATE_VERSION, Refinement
from sononerf.surface.refine.surface_error import error_from_twice
from sononerf.surface.start.read_out import Method
from sononerf.surface.start.volume import vti_bytes
from sononerf.surface.surface import FORMATS, Surface

logger = logging.getLogger("sononerf")

STATE = Path("checkpoints") / "surface.safetensors"
"""Where the state of an interrupted refinement is kept, in the run's folder."""


def refine_surface(
    run: RunFolder, surface: Surface, *, accelerator: str = "auto", progress: Progress
) -> Surface:
    """Refine the surface of a run, or resume an interrupted refinement.

    Args:
        run: Keeps the state until the refinement is done.
        surface: Read out of its field.
        accelerator: Device to compute on.
        progress: Display of progress.

    Raises:
        InputError, IncompatibleError: If the run's echoes are not there, or are others.
        ResourceError: If ``gpu`` was asked for and there is none.
    """
    settings = run.fitted.settings
    starts = starts_of(surface)
    digest = hashlib.sha256(b"".join(mesh.vertices.tobytes() for mesh in starts.values()))
    belongs = {**_version(), "of": f"{model_checksum(run.path)} {digest.hexdigest()}"}
    file = run.path / STATE
    saved = time.monotonic()
    shown = 0

    def after_step(work: Refinement, mismatch: float) -> None:
        nonlocal saved, shown
        del mismatch
        if work.newest is not None and len(work.history) > shown:
            shown = len(work.history)
            with writing(run.path) as writer:
                add_mesh(writer, "mesh/refinement_stages", work.newest, shown)
                error = work.history[-1]["objective_db"]
                writer.add_scalar("refinement/validation_error_dB", error, shown)
        if time.monotonic() - saved > settings.fit.checkpoint_seconds and not work.done:
            tensors = {name: p.cpu().clone().contiguous() for name, p in work.state().items()}
            data = safetensors.torch.save(tensors, metadata=belongs)
            storage.commit_bytes(file, data)
            saved = time.monotonic()

    refined = refine(
        surface,
        run.echoes,
        options=settings.simulation,
        seed=settings.fit.seed,
        accelerator=accelerator,
        state=_saved_state(run, file, belongs),
        after_step=after_step,
        progress=progress,
    )
    storage.remove_file(file)
    return refined


def check_state(run: RunFolder) -> None:
    """Refuse the state of a refinement that went through other stages than those of this version.

    Raises:
        IncompatibleError: If such a state is in the run.
    """
    file = run.path / STATE
    found = _metadata(file)
    if found is not None and any(found.get(key) != value for key, value in _version().items()):
        raise IncompatibleError(
            f"{file}: the refinement was interrupted in another version of sononerf; finish it "
            "with that version, or remove this file to refine from the beginning"
        )


def _version() -> dict[str, str]:
    return {"version": str(STATE_VERSION), "stages": repr(stages.STAGES)}


def _metadata(file: Path) -> dict[str, str] | None:
    """Return the description of a saved state; None if it is missing or damaged."""
    try:
        with safe_open(str(file), "pt") as opened:
            return opened.metadata() or {}
    except (SafetensorError, OSError):
        return None  # without a state the refinement starts from the beginning


def _saved_state(run: RunFolder, file: Path, belongs: dict[str, str]) -> dict[str, Tensor] | None:
    """Return the state of an interrupted refinement of the same starts, or None."""
    if _metadata(file) != belongs:
        return None
    try:
        run.require_recorded(file, "the refinement starts from the beginning")
    except InputError as error:
        logger.warning("%s", error)
        return None
    with safe_open(str(file), "pt") as opened:
        return {name: opened.get_tensor(name) for name in opened.keys()}


def reconstruct(
    run: Path | RunFolder,
    *,
    spacing: float | None = None,
    level: float | Literal["auto"] | None = None,
    method: Method | Literal["auto"] | None = None,
    refine: bool | None = None,
    output: Path | None = None,
    accelerator: str = "auto",
    progress: Progress | None = None,
) -> Path:
    """Write mesh, volume, projections and a view.

    The surface is read out of the field and refined against the echoes that the field was fitted
    to. If a level or a method is given, or if the settings say so, it is not refined unless it is
    asked for.

    Args:
        run: A fitted run.
        spacing (m): Voxel size; the settings' where None.
        level ("auto" or None): A number asks for an iso-surface of this level; the settings' where
            None.
        method: Method of the read-out; that of the settings where None.
        refine: Whether to refine the surface; where None, as above.
        output: Folder of the results; ``RUN/reconstruction`` where None.
        accelerator: Device that refines the surface.
        progress: Display of progress.

    Raises:
        NumericalError: If the field has no surface.
        IncompatibleError: If another version interrupted a refinement of this run.
    """
    progress = progress or Progress(quiet=True)
    run = RunFolder.of(run)
    started = time.monotonic()
    options = run.fitted.settings.reconstruction
    folder = output or run.reconstruction
    own = folder.resolve() == run.reconstruction.resolve()
    # Arguments of the caller replace both settings.
    if method is None:
        method = options.method if level in (None, "auto") else "isosurface"
    if level is None:
        level = options.level if method in ("auto", "isosurface") else "auto"
    if method == "auto" and level != "auto":
        method = "isosurface"
    if level != "auto" and method != "isosurface":
        raise SettingsError(f"method {method} has no level; leave out one of the two")
    if refine and method == "isosurface":
        raise SettingsError("an iso-surface is not refined; leave out --refine, or take a method")
    asked = (method == "auto" and options.refine) if refine is None else refine
    refines = asked and _has_echoes(run, progress)
    chosen = options.model_copy(
        update={"method": method, "level": level, "spacing": spacing or options.spacing}
    )
    with run.locked(None if refines else folder), results_folder(folder):
        truth = _truth(run)
        if refines:
            check_state(run)
        # The start levels needs the echoes; all others do with the free space.
        heard = run.echoes if refines or method == "levels" else run.fitted.hull
        surface = reconstruction.reconstruct(
            run.fitted.module, heard, options=chosen, progress=progress
        )
        if refines:
            surface = refine_surface(run, surface, accelerator=accelerator, progress=progress)
        if own:
            run.begin("surface")
        _write(folder, surface, truth, run.frame())
        if surface.openness is not None and surface.openness.text:
            progress.say(surface.openness.text)
        if output is None:
            run.write_metrics("cost", {"reconstruct_s": time.monotonic() - started}, merge=True)
    return folder


def _has_echoes(run: RunFolder, progress: Progress) -> bool:
    """Return whether the run's echoes are there to refine against; say so where they are not."""
    try:
        return run.echoes is not None
    except InputError as error:
        progress.say(f"the surface is not refined: {error}")
        return False


def _truth(run: RunFolder) -> trimesh.Trimesh | None:
    """Return the true surface, for the view; None, with a warning, where it cannot be read."""
    try:
        return true_mesh(run.fitted.settings, run.provenance)
    except InputError as error:
        logger.warning("the view shows no true surface: %s", error)
        return None


def _write(folder: Path, surface: Surface, truth: trimesh.Trimesh | None, frame: Frame) -> None:
    mesh, seen = surface.mesh, surface.confidence
    assert surface.volume is not None  # it was read out of a field
    for kind in FORMATS:
        storage.commit_bytes(folder / f"mesh.{kind}", surface.file(kind))
        if not frame.is_world:
            data = mesh_bytes(frame.mesh(mesh), kind, confidence=seen, error=surface.error)
            storage.commit_bytes(folder / f"mesh_original.{kind}", data)
    if seen is not None:
        storage.commit_bytes(folder / "confidence.png", confidence_png(mesh, seen))
    storage.commit_bytes(folder / "volume.vti", vti_bytes(surface.volume))
    for axis, picture in mip_pictures(surface.volume).items():
        storage.commit_bytes(folder / f"mip_{axis}.png", picture)
    view = mesh_png(mesh) if truth is None else side_by_side_png(truth, mesh)
    storage.commit_bytes(folder / "view.png", view)
    # Last: a reconstruction without this file is not complete.
    storage.commit_json(
        folder / "read_out.json",
        {
            "method": surface.method,
            "level": surface.level,
            "spacing_m": surface.volume.spacing,
            "surface": None if surface.openness is None else surface.openness.kind,
            "refined": surface.refined,
            "validation_error_db": surface.error_db,
            **_errors(surface),
            "faults": list(surface.faults),
            "candidates": list(surface.candidates),
        },
    )


def _errors(surface: Surface) -> dict[str, float | None]:
    """Return the median error of what was heard, m, and that from twice as many poses."""
    names = "median_error_m", "median_error_from_twice_m"
    heard = surface.confidence is not None and surface.confidence > 0
    if surface.error is None or surface.echoes is None or not np.any(heard):
        return dict.fromkeys(names)
    median = float(np.median(surface.error[heard]))
    if not 0.0 < median < math.inf:
        return dict.fromkeys(names)
    twice = error_from_twice(median, surface.echoes.head.wavelength)
    return dict(zip(names, (median, twice), strict=True))
