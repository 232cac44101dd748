# SPDX-License-Identifier: MIT
"""Compare a run's surface, and the baselines, with the true surface."""

from __future__ import annotations

from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any

from sononerf import storage
from sononerf.evaluation.geometry import BASELINES, Kind, Truth, baselines
from sononerf.progress import Progress
from sononerf.run.build import read_truth, true_scene
from sononerf.run.reconstruct import reconstruct
from sononerf.run.run_folder import RunFolder


def evaluate(
    run: Path | RunFolder,
    *,
    truth: Path | None = None,
    registration: Kind | None = None,
    progress: Progress | None = None,
) -> dict[str, Any]:
    """Compare a reconstruction with the true surface, and the baselines likewise.

    The baselines are moved by the registration of the reconstruction.

    Args:
        run: A run that was reconstructed.
        truth: File of the true surface; ``evaluation.truth`` of the run's settings where None, or
            else the surface of its scene.
        registration: What lays the reconstruction over the truth; ``evaluation.registration`` where
            None.
        progress: Where to show it.

    Returns:
        metrics: All of ``metrics.json``.

    Raises:
        InputError: If the run is none, or the true surface cannot be read.
    """
    progress = progress or Progress(quiet=True)
    run = RunFolder.of(run)
    fitted = run.fitted
    settings = fitted.settings
    with run.locked():
        if not (run.reconstruction / "mesh.ply").is_file():
            reconstruct(run, progress=progress)
        file = truth or settings.evaluation.truth
        scene = true_scene(settings) if file is None else None
        true = read_truth(file) if file is not None else None if scene is None else scene.mesh
        geometry: dict[str, Any] | None = None
        baseline: dict[str, Any] = {"backprojection": None, "voxels": None}
        if true is not None:
            corners = (corner.double().numpy() for corner in fitted.module.field.region)
            with (
                progress.task("evaluating", 1 + len(BASELINES)) as task,
                ThreadPoolExecutor(len(BASELINES)) as pool,
            ):
                volumes = baselines(pool, run.echoes, *corners)
                kind = registration or settings.evaluation.registration
                level = storage.read_json(run.reconstruction / "read_out.json")["level"]
                laid = Truth(true, run.mesh(), kind)
                geometry = {**laid.of_reconstruction(scene), "level": level}
                task.advance()
                for name, volume in volumes:
                    baseline[name] = laid.of_volume(volume)
                    task.advance()
        run.write_metrics("geometry", geometry)
        run.write_metrics("baseline", baseline)
    return run.read_metrics()
