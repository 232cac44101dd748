# SPDX-License-Identifier: MIT
"""Compare a run's surface, and what needs no learning, with the true surface."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from sononerf import storage
from sononerf.echoes.store import EnsembleStore
from sononerf.errors import NumericalError
from sononerf.evaluation.baseline import backprojection, best_level_surface
from sononerf.evaluation.metrics import geometry_metrics, target_metrics
from sononerf.evaluation.registration import Kind, Registration, register
from sononerf.evaluation.true_surface import TrueSurface
from sononerf.evaluation.voxels import voxel_fit
from sononerf.progress import Progress
from sononerf.run.fitted import Fitted, load_fitted, store_of
from sononerf.run.reconstruct import read_mesh, reconstruct
from sononerf.run.run_folder import RunFolder
from sononerf.run.truth import read_truth, true_mesh, true_scene
from sononerf.surface.start.volume import Volume

BASELINE_VOXELS = 64
"""Along the region's longest side; finer than the window's length in any scene of ours."""


def evaluate(
    path: Path,
    *,
    truth: Path | None = None,
    registration: Kind | None = None,
    progress: Progress | None = None,
) -> dict[str, Any]:
    """Compare a reconstruction with the true surface, and the baselines likewise.

    The baselines are moved by the registration of the reconstruction.

    Parameters
    ----------
    path : Path
        A run that was reconstructed.
    truth : Path or None
        File of the true surface; ``evaluation.truth`` of the run's settings where None, or else
        the surface of its scene.
    registration : {"none", "rigid", "similarity"} or None
        What lays the reconstruction over the truth; ``evaluation.registration`` where None.
    progress : Progress or None
        Where to show it.

    Returns
    -------
    metrics : dict
        All of ``metrics.json``.

    Raises
    ------
    InputError
        If the run is none, or the true surface cannot be read.
    """
    progress = progress or Progress(quiet=True)
    run = RunFolder(path)
    fitted = load_fitted(path)
    folder = path / "reconstruction"
    if not (folder / "mesh.ply").is_file():
        reconstruct(path, progress=progress)
    settings = fitted.settings
    true_surface = true_mesh(settings) if truth is None else read_truth(truth)
    scene = true_scene(settings) if truth is None and settings.evaluation.truth is None else None
    geometry: dict[str, Any] | None = None
    baseline: dict[str, Any] = {"backprojection": None, "voxels": None}
    if true_surface is not None:
        kind = registration or settings.evaluation.registration
        with progress.task("evaluating", 3) as task:
            mesh = read_mesh(folder / "mesh.ply")
            level = storage.read_json(folder / "read_out.json")["level"]
            true = TrueSurface(true_surface)
            motion = register(mesh, true_surface, kind)
            mesh = motion.of(mesh)
            geometry = {**geometry_metrics(mesh, true), "level": level}
            if kind != "none":
                geometry["registration"] = {
                    "kind": kind,
                    "scale": motion.scale,
                    "matrix": motion.matrix.tolist(),
                }
            surroundings = None if scene is None else scene.surface(background=True)
            target = None if scene is None else scene.surface(background=False)
            if surroundings is not None and target is not None:
                geometry["target"] = target_metrics(mesh, target, surroundings)
            task.advance()
            near = true if kind == "none" else TrueSurface(motion.inverse().of(true_surface))
            for name, volume in _baselines(fitted):
                baseline[name] = _at_best_level(volume, true, near, motion)
                task.advance()
    run.write_metrics("geometry", geometry)
    run.write_metrics("baseline", baseline)
    return run.read_metrics()


def _baselines(fitted: Fitted) -> Iterator[tuple[str, Volume]]:
    """Yield what needs no learning, read out on one grid: backprojection and voxel fit."""
    store = store_of(fitted)
    train = store.indices("train")
    head = fitted.head
    lower, upper = (corner.double().numpy() for corner in fitted.module.field.region)
    given = (
        store.positions[train],
        store.rotations[train],
        store.range,
        lower,
        upper,
        float((upper - lower).max()) / BASELINE_VOXELS,
    )
    yield (
        "backprojection",
        backprojection(
            _heard(store, train), *given, emitter_offset=head.emitter, ear_offsets=head.receivers
        ),
    )
    fitted_voxels = voxel_fit(
        _heard(store, train),
        *given,
        emitter_offset=head.emitter,
        ear_offsets=head.receivers,
        # Of a sweep each row has a window of its own; where rows are added up, their mean.
        window=np.square(head.window).mean(axis=0),
        window_step=head.speed_of_sound / head.sampling_rate / 2,
    )
    yield "voxels", fitted_voxels


def _heard(store: EnsembleStore, indices: NDArray[np.int64]) -> Iterator[NDArray[np.float32]]:
    return (store.read_pose(int(index)) for index in indices)


def _at_best_level(
    volume: Volume, truth: TrueSurface, near: TrueSurface, motion: Registration
) -> dict[str, Any] | None:
    """Return the metrics of a baseline; ``near`` is the truth in the frame of the volume."""
    try:
        mesh, level = best_level_surface(volume, near)
    except NumericalError:
        return None
    return {**geometry_metrics(motion.of(mesh), truth), "level": level}
