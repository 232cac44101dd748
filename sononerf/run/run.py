# SPDX-License-Identifier: MIT
"""A run that is on disk, opened from Python; and two things of a kind compared."""

from __future__ import annotations

import html
import weakref
from functools import cached_property
from pathlib import Path
from typing import overload

from sononerf.echoes.echoes import Echoes
from sononerf.errors import InputError
from sononerf.evaluation.difference import Comparison
from sononerf.evaluation.numbers import Evaluation, compare_prediction
from sononerf.evaluation.prediction import Prediction, predict
from sononerf.evaluation.traced import Traced, for_single_poses
from sononerf.field.module import EchoModule
from sononerf.geometry.poses import Poses
from sononerf.head.head import Head
from sononerf.progress import Progress
from sononerf.run.compare import compare_runs_of
from sononerf.run.run_folder import RunFolder
from sononerf.settings.schema import Settings
from sononerf.shown import Shown
from sononerf.surface.mesh_files import confidence_of, error_of
from sononerf.surface.surface import Surface


class Run(Shown):
    """A fitted run, opened for reading with :func:`open_run`; each part is loaded at first use.

    Args:
        path: Its folder.

    Raises:
        InputError: If there is no fitted run, or it is damaged.
        IncompatibleError: If it needs another version.
    """

    def __init__(self, path: Path | str) -> None:
        self._folder = RunFolder(Path(path))
        self._fitted = self._folder.fitted

    @property
    def path(self) -> Path:
        """Folder of the run."""
        return self._folder.path

    @property
    def settings(self) -> Settings:
        """Settings of the experiment."""
        return self._fitted.settings

    @property
    def model(self) -> EchoModule:
        """Field and renderer, fitted."""
        return self._fitted.module

    @property
    def head(self) -> Head:
        """Head that heard the echoes."""
        return self._fitted.head

    @property
    def echoes(self) -> Echoes:
        """Echoes that were fitted.

        Raises:
            InputError: If the store is not where the settings say.
            IncompatibleError: If other echoes lie there.
        """
        return self._folder.echoes

    @cached_property
    def surface(self) -> Surface:
        """The reconstructed surface, with the weight of its echoes in a prediction.

        Raises:
            InputError: If there is none, or it is damaged.
        """
        mesh = self._folder.mesh()
        try:
            echoes: Echoes | None = self._folder.echoes
        except InputError:
            echoes = None
        known = self._folder.read_out
        surface = Surface(
            mesh,
            method=known["method"],
            level=known["level"],
            confidence=confidence_of(mesh),
            error=error_of(mesh),
            refined=known["refined"],
            error_db=known["validation_error_db"],
            faults=tuple(known["faults"]),
            candidates=tuple(known.get("candidates", ())),
            echoes=echoes,
        )
        if self._traced is not None:
            surface.learned.append((weakref.ref(self.model), self._traced))
        return surface

    @property
    def metrics(self) -> Evaluation:
        """Content of ``metrics.json``: prediction, geometry, baseline, cost."""
        return Evaluation(self._folder.read_metrics())

    @cached_property
    def _traced(self) -> Traced | None:
        traced = self._folder.traced()
        if traced is None:
            return None
        return for_single_poses(traced, self.head, self.settings.simulation)

    def predict(
        self,
        poses: Poses,
        *,
        traced: bool = True,
        accelerator: str = "auto",
        progress: Progress | None = None,
    ) -> Prediction:
        """Predict the spectrograms of poses, as the command ``predict`` does.

        Args:
            poses: P of them.
            traced: True also traces echoes off the surface: some seconds for the first pose, then
                some tenths of a second for each. The field alone takes some hundredths.
            accelerator: Device to render on: ``auto``, ``cpu`` or ``gpu``.
            progress: Display of progress; on stderr where None.

        Raises:
            InputError: If a pose is too far from the region for anything to be heard.
        """
        return predict(
            self.model,
            self._traced if traced else None,
            poses,
            options=self.settings.simulation,
            accelerator=accelerator,
            progress=progress,
        )

    def __repr__(self) -> str:
        return f"Run({str(self.path)!r})"

    def _repr_html_(self) -> str:
        return f"<b>{html.escape(repr(self))}</b>{self.metrics._repr_html_()}"


def open_run(path: Path | str) -> Run:
    """Open a fitted run; see :class:`Run`."""
    return Run(path)


@overload
def compare(first: Prediction, second: Echoes) -> Evaluation: ...


@overload
def compare(first: Run, second: Run) -> Comparison: ...


def compare(first: Prediction | Run, second: Echoes | Run) -> Evaluation | Comparison:
    """Compare a prediction with echoes, or two runs with each other.

    Args:
        first: A prediction of poses of the echoes; or a run with the target.
        second: The measured echoes; or a run without the target.

    Returns:
        found: For a prediction its errors, ``mae_db`` and others; of runs what the first sends back
            and the second does not.

    Raises:
        InputError: If a pose is not among those of the echoes, or the two do not go together.
        IncompatibleError: If two runs hear differently.
    """
    if isinstance(first, Prediction) and isinstance(second, Echoes):
        return compare_prediction(first, second)
    if isinstance(first, Run) and isinstance(second, Run):
        return compare_runs_of(first._fitted, second._fitted)
    raise InputError(
        f"found {type(first).__name__} and {type(second).__name__}, expected a Prediction and "
        "Echoes, or two runs"
    )
