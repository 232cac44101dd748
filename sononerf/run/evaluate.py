# SPDX-License-Identifier: MIT
"""Compare a run's surface, and the baselines, with the true surface."""

from __future__ import annotations

from concurrent.futures import Future, ThreadPoolExecutor
from contextlib import suppress
from pathlib import Path
from typing import Any

import trimesh

from sononerf.errors import InputError
from sononerf.evaluation.baseline import BASELINES
from sononerf.evaluation.geometry import Kind, Truth, baseline_volume, check_truth
from sononerf.geometry.frame import FrameName
from sononerf.progress import Progress
from sononerf.run.build import Unit, read_truth, true_scene
from sononerf.run.reconstruct import reconstruct
from sononerf.run.run import Run
from sononerf.scene.scene import Scene
from sononerf.surface.start.volume import Volume


class EvaluationWork:
    """An evaluation in other threads, beside other stages; a context that ends them.

    The baselines need no surface: they begin at once.

    Args:
        truth: File of the true surface; ``evaluation.truth`` of the run's settings where None, or
            else the surface of its scene.
        registration: Motion that lays the reconstruction over the truth;
            ``evaluation.registration`` where None.
    """

    def __init__(
        self,
        run: Run,
        truth: Path | None = None,
        registration: Kind | None = None,
        unit: Unit | None = None,
        frame: FrameName | None = None,
    ) -> None:
        settings = run.settings
        self._run = run
        self._file = truth or settings.evaluation.truth
        self._kind: Kind = registration or settings.evaluation.registration
        self._unit: Unit = unit or settings.evaluation.unit
        self._frame = run.frame(frame or settings.evaluation.frame)
        with suppress(InputError):  # raised again by the part that needs the echoes
            _ = run.echoes  # loaded once, before other threads ask for them
        self._pool = ThreadPoolExecutor(len(BASELINES))
        self._true = self._pool.submit(self._truth)
        self._volumes = {name: self._pool.submit(self._volume, name) for name in BASELINES}
        self._parts: dict[str, Future[dict[str, Any] | None]] = {}

    def __enter__(self) -> EvaluationWork:
        return self

    def __exit__(self, *error: object) -> None:
        self._pool.shutdown(cancel_futures=True)

    def begin(self) -> None:
        """Begin the parts that need the reconstructed surface, which the run has."""
        laid = self._pool.submit(self._laid)
        # Threads take tasks in order, so that no task waits for a later one.
        self._parts["geometry"] = self._pool.submit(self._geometry, laid)
        for name in BASELINES:
            self._parts[name] = self._pool.submit(self._baseline, laid, name)

    def result(self, progress: Progress) -> tuple[dict[str, Any] | None, dict[str, Any]]:
        """Wait for the metrics of the surface and those of each baseline; None without a truth."""
        with progress.task("evaluating", len(self._parts)) as task:
            found = {}
            for name, part in self._parts.items():
                found[name] = part.result()
                task.advance()
        return found.pop("geometry"), found

    def _truth(self) -> tuple[Scene | None, trimesh.Trimesh | None]:
        """Return the scene, where that gives the true surface, and the surface."""
        if self._file:
            return None, self._frame.to_world(read_truth(self._file, self._unit))
        scene = true_scene(self._run.settings)
        return scene, None if scene is None else scene.mesh

    def _volume(self, name: str) -> Volume | None:
        if self._true.result()[1] is None:
            return None
        lower, upper = (c.double().numpy() for c in self._run.model.field.region)
        return baseline_volume(name, self._run.echoes, lower, upper)

    def _laid(self) -> Truth | None:
        true = self._true.result()[1]
        if true is None:
            return None
        mesh = self._run.mesh()
        if self._file:
            check_truth(mesh, true, self._kind, str(self._file))
        return Truth(true, mesh, self._kind)

    def _geometry(self, laid: Future[Truth | None]) -> dict[str, Any] | None:
        truth = laid.result()
        if truth is None:
            return None
        level = self._run.read_out["level"]
        return {**truth.of_reconstruction(self._true.result()[0]), "level": level}

    def _baseline(self, laid: Future[Truth | None], name: str) -> dict[str, Any] | None:
        truth, volume = laid.result(), self._volumes[name].result()
        return None if truth is None or volume is None else truth.of_volume(volume)


def evaluate(
    run: Path | Run,
    *,
    truth: Path | None = None,
    registration: Kind | None = None,
    unit: Unit | None = None,
    frame: FrameName | None = None,
    begun: EvaluationWork | None = None,
    progress: Progress | None = None,
) -> dict[str, Any]:
    """Compare a reconstruction with the true surface, and the baselines likewise.

    The baselines are moved by the registration of the reconstruction.

    Args:
        run: A run that was reconstructed.
        truth, registration, unit, frame: As in :class:`EvaluationWork`.
        begun: An evaluation of this run that has begun.
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
        if begun is None:
            with EvaluationWork(run, truth, registration, unit, frame) as work:
                if not (run.reconstruction / "mesh.ply").is_file():
                    reconstruct(run, progress=progress)
                work.begin()
                geometry, baseline = work.result(progress)
        else:
            geometry, baseline = begun.result(progress)
        run.write_metrics("geometry", geometry)
        run.write_metrics("baseline", baseline)
    return run.read_metrics()
