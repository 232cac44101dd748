# SPDX-License-Identifier: MIT
"""What follows a fit: surface, weight of its echoes, prediction, numbers; in this order."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from sononerf.errors import NumericalError
from sononerf.progress import Progress
from sononerf.run.evaluate import evaluate
from sononerf.run.fitted import has_heldout, load_fitted
from sononerf.run.predict import predict
from sononerf.run.reconstruct import reconstruct
from sononerf.run.run_folder import RunFolder
from sononerf.run.traced import NAME as TRACED_NAME
from sononerf.run.traced import learn_traced


def is_finished(path: Path) -> bool:
    """Tell whether a run has all that follows its fit."""
    # The baselines are written last. Another mesh removes the numbers of its geometry.
    has_numbers = {"geometry", "baseline"} <= RunFolder(path).read_metrics().keys()
    files = path / TRACED_NAME, path / "reconstruction" / "mesh.ply"
    return has_numbers and all(file.is_file() for file in files)


def finish(
    path: Path, *, accelerator: str = "auto", progress: Progress | None = None
) -> dict[str, Any]:
    """Reconstruct, find the weight of the surface's echoes, predict held-out poses, evaluate.

    Parameters
    ----------
    path : Path
        A fitted run.
    accelerator : {"auto", "cpu", "gpu"}
        What to render on.
    progress : Progress or None
        Where to show it.

    Returns
    -------
    metrics : dict
        ``RUN/metrics.json``.

    Raises
    ------
    NumericalError
        If the field has no surface; its predictions are written all the same.
    """
    progress = progress or Progress(quiet=True)
    no_surface: NumericalError | None = None
    fitted = load_fitted(path)
    try:
        reconstruct(path, accelerator=accelerator, progress=progress)
        learn_traced(path, accelerator=accelerator, progress=progress)
    except NumericalError as error:
        no_surface = error
    if has_heldout(fitted):
        predict(path, accelerator=accelerator, progress=progress)
    if no_surface is not None:
        raise no_surface
    return evaluate(path, progress=progress)
