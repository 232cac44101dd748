# SPDX-License-Identifier: MIT
"""Check the files of a run against their checksums, and its numbers against these files."""

from __future__ import annotations

import math
from pathlib import Path
from typing import Any, TypedDict, Unpack

import numpy as np

from sononerf import checksums
from sononerf.errors import IncompatibleError, InputError
from sononerf.evaluation.geometry import Kind
from sononerf.evaluation.prediction import predict, prediction_numbers
from sononerf.geometry.frame import FrameName
from sononerf.progress import Progress
from sononerf.run.build import Unit
from sononerf.run.evaluate import EvaluationWork
from sononerf.run.run_folder import RunFolder, flat

TOLERANCE = 1e-3
"""Largest relative difference of two equal numbers. On one machine they agree to the last bit;
other processors and versions of libraries round otherwise."""


class TrueSurface(TypedDict, total=False):
    """Arguments of :class:`sononerf.run.evaluate.EvaluationWork`."""

    truth: Path | None
    registration: Kind | None
    unit: Unit | None
    frame: FrameName | None


def verify(
    path: Path,
    *,
    accelerator: str = "auto",
    progress: Progress | None = None,
    **true: Unpack[TrueSurface],
) -> dict[str, int]:
    """Check all files of a run, and compute its numbers again from field, echoes and surface.

    Nothing is written.

    Args:
        path: A run that was evaluated.
        accelerator: Device to render on.
        progress: Display of progress.
        true: As it was given to :func:`sononerf.run.evaluate.evaluate`.

    Returns:
        checked: Numbers of ``files`` and ``numbers`` that hold.

    Raises:
        InputError: If a file is missing or is not as it was written, or a number is missing; one
            line for each.
        IncompatibleError: If a number does not follow from the files; one line for each.
    """
    progress = progress or Progress(quiet=True)
    run = RunFolder(path)
    run.open()
    damaged = checksums.differing(path)
    if damaged:
        raise InputError(
            "\n".join(f"{path / name}: missing, damaged, or changed by hand" for name in damaged)
        )
    known = run.read_metrics()
    found: dict[str, Any] = {}
    if "prediction" in known:
        found["prediction"] = _prediction(run, accelerator, progress)
    if "geometry" in known:
        with EvaluationWork(run, **true) as work:
            work.begin()
            found["geometry"], found["baseline"] = work.result(progress)
    if not found:
        raise InputError(f"{run.metrics}: holds no numbers yet; the same fit command goes on")
    numbers = flat(found)
    stated = flat({name: known.get(name) for name in found})
    wrong = [
        f"{run.metrics}: {key} is {stated.get(key)}, and the files give {value}"
        for key, value in numbers.items()
        if not _equal(stated.get(key), value)
    ]
    if wrong:
        raise IncompatibleError("\n".join(wrong))
    return {"files": checksums.count(path), "numbers": len(numbers)}


def _prediction(run: RunFolder, accelerator: str, progress: Progress) -> dict[str, Any]:
    """Predict the test poses again, and compare with the store."""
    fitted, echoes = run.fitted, run.echoes
    found = predict(
        fitted.module,
        run.traced(),
        echoes.poses("test"),
        options=fitted.settings.simulation,
        accelerator=accelerator,
        progress=progress,
    )
    numbers = echoes.store.indices("test")
    measured = np.stack([echoes.spectrogram(int(index)) for index in numbers])
    return prediction_numbers(found, echoes, measured)


def _equal(stated: Any, found: Any) -> bool:
    """Return whether two values agree; numbers within the tolerance."""
    if isinstance(found, (list, tuple, np.ndarray)):
        return (
            isinstance(stated, list)
            and len(stated) == len(found)
            and all(map(_equal, stated, list(found)))
        )
    if isinstance(stated, (int, float)) and isinstance(found, (int, float, np.number)):
        return math.isclose(stated, float(found), rel_tol=TOLERANCE, abs_tol=1e-9)
    return bool(stated == found)
