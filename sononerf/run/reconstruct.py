# SPDX-License-Identifier: MIT
"""Read a fitted field out to files, and compare it with the true scene."""

from __future__ import annotations

import math
import time
from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Literal

import numpy as np
import torch
import trimesh

from sononerf import storage
from sononerf.errors import InputError, NumericalError
from sononerf.progress import Progress, Task
from sononerf.report.mesh_files import MeshFormat, mesh_bytes
from sononerf.report.pictures.mesh_picture import confidence_png, mesh_png, side_by_side_png
from sononerf.report.pictures.mip_picture import mip_pngs
from sononerf.run.fitted import Fitted, load_fitted, store_of
from sononerf.run.refine import refine_surface
from sononerf.run.run_folder import RunFolder, results_folder
from sononerf.run.truth import true_mesh
from sononerf.surface.refine.refinement import Refined
from sononerf.surface.start.read_out import Method, Reconstruction, judged
from sononerf.surface.start.read_out import reconstruct as read_out
from sononerf.surface.start.volume import vti_bytes

OPEN = {
    "sheet": "the surface is a sheet: {0.thin_share:.0%} of it has its other side right behind it",
    "one-sided": "the surface is open: {0.unseen_share:.0%} of it, which no pose heard, is "
    "left out",
}
"""What is said of surfaces that do not enclose a body."""
REFINED: tuple[Method, ...] = ("open", "filled", "hull", "sheet")
"""Start surfaces: the one that explains the validation poses best is refined, see
:class:`~sononerf.surface.refine.refinement.Refinement`."""
UNREFINED: tuple[Method, ...] = ("filled", "hull")
"""Without refinement the first of these that gives a surface is taken."""
FORMATS: tuple[MeshFormat, ...] = ("ply", "stl", "glb")


def reconstruct(
    path: Path,
    *,
    spacing: float | None = None,
    level: float | Literal["auto"] | None = None,
    method: Method | Literal["auto"] | None = None,
    output: Path | None = None,
    accelerator: str = "auto",
    progress: Progress | None = None,
) -> Path:
    """Write mesh, volume, projections and a view.

    The surface is read out of the field and refined against the echoes that the field was fitted
    to. It is not refined if a level or a method is given, or if the settings say so.

    Parameters
    ----------
    path : Path
        A fitted run.
    spacing : float or None, m
        Voxel size; the settings' where None.
    level : float, "auto" or None
        A number asks for an iso-surface of this level; the settings' where None.
    method : {"auto", "open", "filled", "hull", "sheet", "isosurface"} or None
        How the surface is read out; the settings' where None.
    output : Path or None
        Folder of the results; ``RUN/reconstruction`` where None.
    accelerator : {"auto", "cpu", "gpu"}
        What the surface is refined on.
    progress : Progress or None
        Where to show it.

    Returns
    -------
    folder : Path
    """
    progress = progress or Progress(quiet=True)
    started = time.monotonic()
    fitted = load_fitted(path)
    folder = output or path / "reconstruction"
    options = fitted.settings.reconstruction
    # What the caller gives replaces both settings.
    if method is None:
        method = options.method if level in (None, "auto") else "isosurface"
    if level is None:
        level = options.level if method in ("auto", "isosurface") else "auto"
    methods: tuple[Method, ...]
    refines = False
    if method != "auto":
        methods = (method,)
    elif level != "auto":
        methods = ("isosurface",)
    else:
        refines = options.refine
        methods = REFINED if refines else UNREFINED
    with results_folder(folder):
        starts = _read_out(
            fitted,
            methods=methods,
            several=refines,
            spacing=spacing or options.spacing,
            level=level,
            progress=progress,
        )
        if folder.resolve() == (path / "reconstruction").resolve():
            RunFolder(path).drop_metrics("geometry")  # of the mesh that is replaced
        found, refined = starts[0], None
        if refines:
            meshes: dict[str, trimesh.Trimesh] = {start.method: start.mesh for start in starts}
            refined = _refined(path, fitted, meshes, accelerator, progress)
        if refined is not None:
            start = next(start for start in starts if start.method == refined.start)
            found = replace(start, mesh=refined.mesh)
        found = judged(found, None if refined is None else refined.support.round().astype(np.int32))
        _write(folder, found, refined, true_mesh(fitted.settings))
    if found.openness is not None and found.openness.kind in OPEN:
        progress.say(OPEN[found.openness.kind].format(found.openness))
    if output is None:
        RunFolder(path).write_metrics(
            "cost", {"reconstruct_s": time.monotonic() - started}, merge=True
        )
    return folder


def _read_out(
    fitted: Fitted,
    *,
    methods: Sequence[Method],
    several: bool,
    spacing: float | None,
    level: float | Literal["auto"],
    progress: Progress,
) -> list[Reconstruction]:
    """Read surfaces out of the field by some methods: all of them, or the first that gives one.

    Raises
    ------
    NumericalError
        If none gives a surface.
    """
    options = fitted.settings.reconstruction
    found: list[Reconstruction] = []
    error: NumericalError | None = None
    for method in methods:
        if found and not several:
            break
        try:
            with progress.task("reconstructing", 1000) as task, torch.inference_mode():

                def shown(done: int, total: int, task: Task = task) -> None:
                    task.advance(1000 * done // total - task.done)

                one = read_out(
                    fitted.module.field,
                    hull=fitted.hull,
                    spacing=spacing,
                    level=level,
                    method=method,
                    directions=options.directions,
                    smoothing=options.smoothing if method == "isosurface" else 0.0,
                    resolution=fitted.head.resolution,
                    earlier=found[-1] if found else None,
                    judge=False,
                    progress=shown,
                )
            found.append(one)
        except NumericalError as raised:
            error = error or raised
    if error is not None and not found:
        raise error
    return found


def _refined(
    path: Path,
    fitted: Fitted,
    starts: Mapping[str, trimesh.Trimesh],
    accelerator: str,
    progress: Progress,
) -> Refined | None:
    """Return the refined surface; None where the run's echoes are not there."""
    try:
        store_of(fitted)
    except InputError as error:
        progress.say(f"the surface is not refined: {error}")
        return None
    return refine_surface(path, fitted, starts, accelerator=accelerator, progress=progress)


def _write(
    folder: Path,
    found: Reconstruction,
    refined: Refined | None,
    truth: trimesh.Trimesh | None,
) -> None:
    seen = found.support
    for kind in FORMATS:
        data = mesh_bytes(found.mesh, kind, confidence=seen)
        storage.commit_bytes(folder / f"mesh.{kind}", data)
    if seen is not None:
        storage.commit_bytes(folder / "confidence.png", confidence_png(found.mesh, seen))
    storage.commit_bytes(folder / "volume.vti", vti_bytes(found.volume))
    for axis, picture in mip_pngs(found.volume).items():
        storage.commit_bytes(folder / f"mip_{axis}.png", picture)
    view = mesh_png(found.mesh) if truth is None else side_by_side_png(truth, found.mesh)
    storage.commit_bytes(folder / "view.png", view)
    storage.commit_json(
        folder / "read_out.json",
        {
            "method": found.method,
            "level": found.level,
            "spacing_m": found.volume.spacing,
            "surface": None if found.openness is None else found.openness.kind,
            "refined": refined is not None and refined.kept,
            "validation_error_db": None
            if refined is None or not math.isfinite(refined.error_db)
            else refined.error_db,
        },
    )


def read_mesh(path: Path) -> trimesh.Trimesh:
    """Read a reconstructed surface back.

    Raises
    ------
    InputError
        If it is damaged or empty.
    """
    try:
        mesh = trimesh.load_mesh(path, file_type="ply")
    except Exception as error:  # trimesh's readers raise whatever they met first
        raise InputError(f"{path}: damaged ({error}); reconstruct again") from error
    if not isinstance(mesh, trimesh.Trimesh) or not len(mesh.faces):
        raise InputError(f"{path}: holds no surface; reconstruct again")
    return mesh
