# SPDX-License-Identifier: MIT
"""Compare a run's surface, and the baselines, with the true surface."""

from __future__ import annotations

from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any

from sononerf.evaluation.baseline import BASELINES
from sononerf.evaluation.geometry import Kind, Truth, baseline_volume, check_truth
from sononerf.geometry.frame import FrameName
from sononerf.progress import Progress
from sononerf.run.build import Unit, read_truth, true_scene
from sononerf.run.reconstruct import reconstruct
from sononerf.run.run import Run


def evaluate(
    run: Path | Run,
    *,
    truth: Path | None = None,
    registration: Kind | None = None,
    unit: Unit | None = None,
    frame: FrameName | None = None,
    progress: Progress | None = None,
) -> dict[str, Any]:
    """Compare a reconstruction with the true surface, and the baselines likewise.

    The baselines are moved by the registration of the reconstruction.

    Args:
        run: A run that was reconstructed.
        truth: File of the true surface; ``evaluation.truth`` of the run's settings where None, or
            else the surface of its scene.
        registration, unit, frame: Its registration, unit and frame; those of the settings where
            None.
        progress: Display of progress.

    Returns:
        metrics: All of ``metrics.json``.

    Raises:
        InputError: If the run is none, or the true surface cannot be read.
    """
    progress = progress or Progress(quiet=True)
    run = Run.of(run)
    _ = run.model  # a folder that is no run is refused before it is locked
    with run.locked():
        if not (run.reconstruction / "mesh.ply").is_file():
            reconstruct(run, progress=progress)
        chosen = run.settings.evaluation
        file, kind = truth or chosen.truth, registration or chosen.registration
        scene = None if file else true_scene(run.settings)
        if file:
            to_world = run.frame(frame or chosen.frame).to_world
            true = to_world(read_truth(file, unit or chosen.unit))
            check_truth(run.mesh(), true, kind, str(file))
        elif scene is not None:
            true = scene.mesh
        else:
            run.write_metrics("geometry", None)
            run.write_metrics("baseline", dict.fromkeys(BASELINES))
            return run.read_metrics()
        laid, echoes = Truth(true, run.mesh(), kind), run.echoes
        lower, upper = (corner.double().numpy() for corner in run.model.field.region)

        def baseline(name: str) -> dict[str, Any] | None:
            return laid.of_volume(baseline_volume(name, echoes, lower, upper))

        with (
            progress.task("evaluating", 1 + len(BASELINES)) as task,
            ThreadPoolExecutor(len(BASELINES)) as pool,
        ):
            parts = {name: pool.submit(baseline, name) for name in BASELINES}
            geometry = {**laid.of_reconstruction(scene), "level": run.read_out["level"]}
            task.advance()
            baselines = {}
            for name, part in parts.items():
                baselines[name] = part.result()
                task.advance()
        run.write_metrics("geometry", geometry)
        run.write_metrics("baseline", baselines)
    return run.read_metrics()
