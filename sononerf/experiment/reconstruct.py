# SPDX-License-Identifier: MIT
"""Read a fitted field out to files, and compare it with the true scene."""

from __future__ import annotations

import math
import time
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any, Literal

import numpy as np
import torch
import trimesh
from numpy.typing import NDArray

from sononerf import storage
from sononerf.data.store import EnsembleStore
from sononerf.errors import InputError, NumericalError, SonoNerfError
from sononerf.experiment.build import acquisition, point_echo
from sononerf.experiment.fitted import Fitted, load_fitted, store_of
from sononerf.experiment.run_folder import RunFolder, results_folder
from sononerf.experiment.surface import refine_surface
from sononerf.progress import Progress, Task
from sononerf.reconstruction.baseline import backprojection, best_level_surface
from sononerf.reconstruction.mesh import MeshFormat, mesh_bytes
from sononerf.reconstruction.metrics import geometry_metrics, target_metrics
from sononerf.reconstruction.read_out import Method, Reconstruction, judged
from sononerf.reconstruction.read_out import reconstruct as read_out
from sononerf.reconstruction.truth import TrueSurface
from sononerf.reconstruction.volume import Volume, vti_bytes
from sononerf.reconstruction.voxels import voxel_fit
from sononerf.render.mesh import confidence_png, mesh_png, side_by_side_png
from sononerf.render.projection import mip_pngs
from sononerf.scene import Scene, load_scene
from sononerf.surface.refine import Refined

OPEN = {
    "sheet": "the surface is a sheet: {0.thin_share:.0%} of it has its other side right behind it",
    "one-sided": "the surface is open: {0.unseen_share:.0%} of it, which no pose heard, is "
    "left out",
}
"""What is said of surfaces that do not enclose a body."""
REFINED: tuple[Method, ...] = ("open", "filled", "hull", "sheet")
"""Start surfaces: the one that explains the validation poses best is refined, see
:class:`~sononerf.surface.refine.Refinement`."""
UNREFINED: tuple[Method, ...] = ("filled", "hull")
"""Without refinement the first of these that gives a surface is taken."""
FORMATS: tuple[MeshFormat, ...] = ("ply", "stl", "glb")
BASELINE_VOXELS = 64
"""Along the region's longest side; finer than the window's length in any scene of ours."""


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
        _write(folder, found, refined, true_mesh(fitted))
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
    resolution = point_echo(fitted.settings).resolution
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
                    resolution=resolution,
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


def true_scene(fitted: Fitted) -> Scene | None:
    """Return the scene that a run is of; None where it is not installed here."""
    try:
        return load_scene(fitted.settings.scene.name, fitted.settings.scene.options)
    except SonoNerfError:
        return None


def true_mesh(fitted: Fitted) -> trimesh.Trimesh | None:
    """Return the scene's own surface; None where the scene is not installed here."""
    scene = true_scene(fitted)
    return None if scene is None else scene.mesh


def evaluate(path: Path, *, progress: Progress | None = None) -> dict[str, Any]:
    """Compare a reconstruction with the true scene, and the baselines likewise.

    Parameters
    ----------
    path : Path
        A run that was reconstructed.
    progress : Progress or None
        Where to show it.

    Returns
    -------
    metrics : dict
        All of ``metrics.json``.
    """
    progress = progress or Progress(quiet=True)
    run = RunFolder(path)
    fitted = load_fitted(path)
    folder = path / "reconstruction"
    if not (folder / "mesh.ply").is_file():
        reconstruct(path, progress=progress)
    scene = true_scene(fitted)
    geometry: dict[str, Any] | None = None
    baseline: dict[str, Any] = {"backprojection": None, "voxels": None}
    if scene is not None:
        with progress.task("evaluating", 3) as task:
            mesh = read_mesh(folder / "mesh.ply")
            level = storage.read_json(folder / "read_out.json")["level"]
            true = TrueSurface(scene.mesh)
            geometry = {**geometry_metrics(mesh, true), "level": level}
            surroundings = scene.surface(background=True)
            target = scene.surface(background=False)
            if surroundings is not None and target is not None:
                geometry["target"] = target_metrics(mesh, target, surroundings)
            task.advance()
            for name, volume in _baselines(fitted):
                baseline[name] = _at_best_level(volume, true)
                task.advance()
    run.write_metrics("geometry", geometry)
    run.write_metrics("baseline", baseline)
    return run.read_metrics()


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


def _baselines(fitted: Fitted) -> Iterator[tuple[str, Volume]]:
    """Yield what needs no learning, read out on one grid: backprojection and voxel fit."""
    store = store_of(fitted)
    train = store.indices("train")
    known = acquisition(fitted.settings)
    lower, upper = (corner.double().numpy() for corner in fitted.module.field.region)
    given = (
        store.positions[train],
        store.rotations[train],
        store.range,
        lower,
        upper,
        float((upper - lower).max()) / BASELINE_VOXELS,
    )
    emitter, ears = known.emitter.double().numpy(), known.ear_positions.double().numpy()
    yield (
        "backprojection",
        backprojection(_heard(store, train), *given, emitter_offset=emitter, ear_offsets=ears),
    )
    fitted_voxels = voxel_fit(
        _heard(store, train),
        *given,
        emitter_offset=emitter,
        ear_offsets=ears,
        # Of a sweep each row has a window of its own; where rows are added up, their mean.
        window=known.window.double().square().mean(dim=0).numpy(),
        window_step=known.speed_of_sound / known.sampling_rate / 2,
    )
    yield "voxels", fitted_voxels


def _heard(store: EnsembleStore, indices: NDArray[np.int64]) -> Iterator[NDArray[np.float32]]:
    return (store.read_pose(int(index)) for index in indices)


def _at_best_level(volume: Volume, truth: TrueSurface) -> dict[str, Any] | None:
    try:
        mesh, level = best_level_surface(volume, truth)
    except NumericalError:
        return None
    return {**geometry_metrics(mesh, truth), "level": level}
