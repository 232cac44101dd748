# SPDX-License-Identifier: MIT
"""The stages after a fit: surface, weight of its echoes, prediction, numbers; in this order."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from sononerf.errors import NumericalError, ResourceError
from sononerf.evaluation.traced import Traced, learn_traced
from sononerf.progress import Progress
from sononerf.run.evaluate import evaluate
from sononerf.run.predict import predict
from sononerf.run.reconstruct import reconstruct
from sononerf.run.run_folder import RunFolder


def finish(
    run: Path | RunFolder, *, accelerator: str = "auto", progress: Progress | None = None
) -> dict[str, Any]:
    """Reconstruct, find the weight of the surface's echoes, predict held-out poses, evaluate.

    Stages that are done are left out, so that an interrupted call goes on with its own stage.

    Args:
        run: A fitted run.
        accelerator: What to render on.
        progress: Where to show it.

    Returns:
        metrics: ``RUN/metrics.json``.

    Raises:
        NumericalError: If the field has no surface; its predictions are written all the same.
    """
    progress = progress or Progress(quiet=True)
    run = RunFolder.of(run)
    shown: dict[str, Any] = {"accelerator": accelerator, "progress": progress}
    no_surface: NumericalError | None = None
    with run.locked():
        try:
            if not run.is_done("surface"):
                reconstruct(run, **shown)
            if not run.is_done("traced"):
                _learn_traced(run, accelerator, progress)
        except NumericalError as error:
            no_surface = error
        if not run.is_done("prediction"):
            predict(run, **shown)
        if no_surface is not None:
            raise no_surface
        if not run.is_done("evaluation"):
            evaluate(run, progress=progress)
    return run.read_metrics()


def _learn_traced(run: RunFolder, accelerator: str, progress: Progress) -> None:
    settings, mesh = run.fitted.settings, run.mesh()
    run.begin("traced")
    if settings.prediction.traced == "off":
        traced = Traced.none(mesh, run.fitted.head)
    else:
        try:
            traced = learn_traced(
                run.fitted,
                run.echoes,
                mesh,
                settings.simulation,
                seed=settings.fit.seed,
                accelerator=accelerator,
                progress=progress,
            )
        except ResourceError as error:
            progress.say(
                f"no echoes are traced off the surface; the same command tries again: {error}"
            )
            return
    run.keep_traced(traced)
