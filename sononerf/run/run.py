# SPDX-License-Identifier: MIT
"""A run: an experiment in a folder, its settings, its stages, and what they left.

Settings go in; echoes, a field, a surface, predictions and numbers come out, in this order::

    simulate     settings          -> echoes       data/<scene>-<hash>/
    fit          echoes            -> field        model.safetensors, model.json
    reconstruct  field, echoes     -> surface      reconstruction/
    predict      field, surface    -> prediction   prediction/
    evaluate     all of these      -> numbers      metrics.json

Each stage reads what those before it left and writes its own file last: it is done when that file
is there. A stage that was killed is done again; a fit goes on from its checkpoint, a refinement
from its last stage. The formulas are in ``docs/method.md``.
"""

from __future__ import annotations

import html
import os
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import replace
from functools import cached_property
from pathlib import Path
from typing import Any, Literal
from weakref import WeakKeyDictionary

import numpy as np
import trimesh
from numpy.typing import NDArray

from sononerf import storage
from sononerf.display import NotebookRepr
from sononerf.echoes.echoes import Echoes
from sononerf.errors import IncompatibleError, InputError
from sononerf.evaluation.numbers import Evaluation
from sononerf.evaluation.prediction import TRACED, Prediction, predict
from sononerf.evaluation.traced import Traced, for_single_poses
from sononerf.field.checkpoint_io import DESCRIPTION_NAME
from sononerf.field.module import EchoModule
from sononerf.geometry.poses import Frame, FrameName, Poses
from sononerf.head.call import attach
from sononerf.head.head import Head
from sononerf.progress import Progress
from sononerf.run import build
from sononerf.run.build import differing_keys, versions
from sononerf.run.simulate import find_ensemble
from sononerf.settings.loading import dump_yaml, read_yaml, validate_settings
from sononerf.settings.schema import Settings
from sononerf.simulation.simulator import ensemble_poses
from sononerf.start.surface import Surface, confidence_of, error_of

METRICS_SCHEMA = 1
StageName = Literal["fit", "surface", "traced", "prediction", "evaluation"]
STAGES: tuple[StageName, ...] = ("fit", "surface", "traced", "prediction", "evaluation")
"""Stages of a run, in order: the fit; the reconstruction; gain and weight of echoes traced off it;
the prediction of held-out poses; the comparison with the true surface and the baselines."""


class Run(NotebookRepr):
    """A run on disk; each of its parts is loaded at first use.

    Args:
        path: Its folder.
    """

    def __init__(self, path: Path | str) -> None:
        self.path = Path(path)
        self.config = self.path / "config.yaml"
        self.metrics_file = self.path / "metrics.json"
        self.checkpoint = self.path / "checkpoints" / "last.ckpt"
        self.reconstruction = self.path / "reconstruction"
        self._locks = 0
        self._kept: Traced | None = None

    def __repr__(self) -> str:
        return f"Run({str(self.path)!r})"

    def _repr_html_(self) -> str:
        return f"<b>{html.escape(repr(self))}</b>{self.metrics._repr_html_()}"

    @classmethod
    def of(cls, run: Path | Run) -> Run:
        """Return the run of a path, or the same run."""
        return run if isinstance(run, Run) else cls(run)

    @contextmanager
    def locked(self, output: Path | None = None) -> Iterator[None]:
        """Hold the run against other processes; within one process it can be held repeatedly."""
        elsewhere = output is not None and not output.resolve().is_relative_to(self.path.resolve())
        if self._locks or elsewhere:
            yield
            return
        with storage.lock(self.path):
            self._locks += 1
            try:
                yield
            finally:
                self._locks -= 1

    # What its stages left.

    @cached_property
    def _model(self) -> build.Model:
        return build.read_model(self.path)

    @property
    def model(self) -> EchoModule:
        """Field and renderer, fitted.

        Raises:
            InputError: If there are none, or they are damaged.
            IncompatibleError: If they need another version.
        """
        return self._model.module

    @property
    def settings(self) -> Settings:
        """Settings of the fitted experiment."""
        return self._model.settings

    @property
    def echo_hash(self) -> str:
        """Hash of the echoes that were fitted."""
        return self._model.echo_hash

    @property
    def head(self) -> Head:
        """Head that heard the echoes."""
        assert self.model.head is not None  # it was made with one
        return self.model.head

    @cached_property
    def echoes(self) -> Echoes:
        """Echoes that were fitted.

        Raises:
            InputError: If the store is not where the settings say.
            IncompatibleError: If other echoes lie there.
        """
        store = find_ensemble(self.settings, self.echo_hash, self.path)
        box = self.model.field.region.cpu().double().numpy()
        return Echoes(store, self.head, self._model.hull, box)

    def all_poses(self) -> tuple[Poses, NDArray[np.int8]]:
        """Return all poses and the use of each (P,): 0 train, 1 val, 2 test."""
        if self.settings.scene is not None:
            return ensemble_poses(self.settings.poses)
        store = self.echoes.store
        return Poses(store.positions, store.rotations), store.split

    @property
    def has_heldout(self) -> bool:
        """Whether poses were held out of the fit."""
        settings = self.settings
        if settings.scene is not None:
            return settings.poses.heldout > 0
        return len(self.echoes.store.indices("test")) > 0

    @property
    def provenance(self) -> dict[str, Any]:
        """Versions, machine and sources of the run; empty if the file is missing."""
        file = self.path / build.PROVENANCE_NAME
        found = storage.read_json(file) if file.is_file() else {}
        return found if isinstance(found, dict) else {}

    def frame(self, name: FrameName = "auto") -> Frame:
        """Return the frame of that name; see :meth:`sononerf.geometry.poses.Frame.of`."""
        return Frame.of(self.provenance, name)

    def mesh(self) -> trimesh.Trimesh:
        """Read the reconstructed surface."""
        return build.read_mesh(
            self.reconstruction / "mesh.ply", f"sononerf reconstruct {self.path}"
        )

    @property
    def read_out(self) -> dict[str, Any]:
        """Settings with which the reconstructed surface was read out."""
        file = self.reconstruction / "read_out.json"
        again = f"reconstruct again with `sononerf reconstruct {self.path}`"
        found = storage.read_json(file)
        if not isinstance(found, dict):
            raise InputError(f"{file}: damaged; {again}")
        return found

    @cached_property
    def surface(self) -> Surface:
        """The reconstructed surface, with the weight of its echoes in a prediction.

        Raises:
            InputError: If there is none, or it is damaged.
        """
        mesh = self.mesh()
        try:
            echoes: Echoes | None = self.echoes
        except InputError:
            echoes = None
        read_out = self.read_out
        surface = Surface(
            mesh,
            method=read_out["method"],
            level=read_out["level"],
            confidence=confidence_of(mesh),
            error=error_of(mesh),
            refined=read_out["refined"],
            error_db=read_out["validation_error_db"],
            faults=tuple(read_out["faults"]),
            echoes=echoes,
        )
        if self._traced is not None:
            TRACED[surface] = WeakKeyDictionary({self.model: self._traced})
        return surface

    @property
    def metrics(self) -> Evaluation:
        """Content of ``metrics.json``: prediction, geometry, baseline, cost."""
        return Evaluation(self.read_metrics())

    @cached_property
    def _traced(self) -> Traced | None:
        traced = self.traced()
        if traced is None:
            return None
        return for_single_poses(traced, self.head, self.settings.simulation)

    def traced(self) -> Traced | None:
        """Return the surface that echoes are traced off, and their weight; None without them."""
        found, kept = build.load_traced(self.path), self._kept
        if found is None or kept is None or not build.same_mesh(found.mesh, kept.mesh):
            return found
        return replace(found, simulator=kept.simulator)

    def keep_traced(self, traced: Traced) -> None:
        """Write the traced surface, with its gain and weight."""
        build.save_traced(self.path, traced)
        self._kept = traced

    def _traces_its_mesh(self) -> bool:
        """Return True if the traced surface is that of the reconstruction."""
        try:
            traced, mesh = self.traced(), self.mesh()
        except InputError:
            return False
        return traced is not None and build.same_mesh(traced.mesh, mesh)

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
            progress: Display of progress; on stderr by default.

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

    # Its stages; each is the function of that name, which says what may be given.

    def fit(self, settings: Settings, **given: Any) -> Run:
        """Simulate where needed, and fit; see :func:`sononerf.run.fit.fit`."""
        from sononerf.run.fit import fit

        return fit(settings, self.path, **given)

    def reconstruct(self, **given: Any) -> Path:
        """Reconstruct the surface; see :func:`sononerf.run.reconstruct.reconstruct`."""
        from sononerf.run.reconstruct import reconstruct

        return reconstruct(self, **given)

    def write_prediction(self, **given: Any) -> Path:
        """Predict a split, or a table of poses; see :func:`sononerf.run.predict.predict`."""
        from sononerf.run.predict import predict as write

        return write(self, **given)

    def evaluate(self, **given: Any) -> dict[str, Any]:
        """Compare with the true surface; see :func:`sononerf.run.evaluate.evaluate`."""
        from sononerf.run.evaluate import evaluate

        return evaluate(self, **given)

    def finish(self, **given: Any) -> dict[str, Any]:
        """Do the stages after the fit that are not done; see :func:`sononerf.run.fit.finish`."""
        from sononerf.run.fit import finish

        return finish(self, **given)

    # Which stages are done.

    def is_done(self, stage: StageName) -> bool:
        """Return True if a stage came to its end, with the results of the stages before it."""
        if stage == "fit":
            return (self.path / DESCRIPTION_NAME).is_file()
        if stage == "surface":
            # The description is written after all else.
            names = ("mesh.ply", "read_out.json")
            return all((self.reconstruction / name).is_file() for name in names)
        if stage == "traced":
            return self._traces_its_mesh()
        found = self.read_metrics().keys()
        if stage == "prediction":
            return "prediction" in found or not self.has_heldout
        return {"geometry", "baseline"} <= found

    @property
    def is_finished(self) -> bool:
        """True if all stages are complete."""
        return all(self.is_done(stage) for stage in STAGES)

    def begin(self, stage: Literal["surface", "traced"]) -> None:
        """Mark a stage as not done, and the evaluation or prediction that depends on it."""
        if stage == "surface":
            storage.remove_file(self.reconstruction / "read_out.json")
            self.drop_metrics("geometry")
        else:
            self.drop_metrics("prediction")

    def open(self) -> Settings:
        """Return the settings of a run that is there."""
        if not self.config.is_file():
            raise InputError(f"{self.path}: no run (no config.yaml); make one with `sononerf fit`")
        return validate_settings(read_yaml(self.config), str(self.config))

    def check(self, settings: Settings) -> None:
        """Make sure that the folder is free, or holds a run of the same settings."""
        if self.config.is_file():
            different = differing_keys(self.open(), settings)
            if different:
                raise IncompatibleError(
                    f"{self.path}: holds a run of other settings ({', '.join(different[:5])}"
                    f"{', ...' if len(different) > 5 else ''}); choose another --output, or "
                    "--overwrite to move it aside"
                )
            return
        self.refuse_foreign()

    def prolong(self, settings: Settings) -> None:
        """Take over a larger number of epochs, if nothing else differs."""
        if not self.config.is_file():
            return
        old = self.open()
        if differing_keys(old, settings) == ["fit.epochs"] and settings.fit.epochs > old.fit.epochs:
            storage.remove_file(self.path / DESCRIPTION_NAME)
            self.begin("surface")
            self.begin("traced")
            storage.commit_text(self.config, dump_yaml(settings))

    def refuse_foreign(self) -> None:
        """Refuse a folder that holds something else."""
        foreign = [p.name for p in self.path.iterdir() if p.name[0] != "."]
        if foreign:
            raise InputError(
                f"{self.path}: holds {sorted(foreign)[0]!r} and is no run; choose another --output"
            )

    def begin_fit(self, settings: Settings) -> None:
        """Write the settings of a new run, or make sure that an old one has the same."""
        self.check(settings)
        if not self.config.is_file():
            attach(settings, self.path)
            storage.commit_text(self.config, dump_yaml(settings))

    def move_aside(self) -> Path | None:
        """Rename the folder so that a new run can take its place; nothing is deleted."""
        if not self.path.exists():
            return None
        path = self.path.resolve()
        number = 1
        while (aside := path.with_name(f"{path.name}.old-{number}")).exists():
            number += 1
        if not self.config.is_file():
            self.refuse_foreign()
        with storage.lock(path):
            try:
                path.rename(aside)
            except OSError as error:
                raise storage.storage_error("cannot be moved aside", path, error) from error
        return aside

    def read_metrics(self) -> dict[str, Any]:
        """Return the present content of ``metrics.json``."""
        if not self.metrics_file.is_file():
            return {"schema": METRICS_SCHEMA}
        metrics = storage.read_json(self.metrics_file)
        if not isinstance(metrics, dict):
            raise InputError(f"{self.metrics_file}: holds no metrics; remove it and evaluate again")
        return metrics

    def write_metrics(
        self, section: str, values: dict[str, Any] | None, *, merge: bool = False
    ) -> None:
        """Replace one section of ``metrics.json``; the others are left as they are."""
        with self.locked():
            metrics = self.read_metrics()
            if merge:
                values = {**(metrics.get(section) or {}), **(values or {})}
            metrics |= {"schema": METRICS_SCHEMA, section: values}
            storage.commit_json(self.metrics_file, metrics)

    def drop_metrics(self, section: str) -> None:
        """Take one section out of ``metrics.json``, where it is there."""
        with self.locked():
            metrics = self.read_metrics()
            if section in metrics:
                del metrics[section]
                storage.commit_json(self.metrics_file, metrics)

    def write_provenance(self, **facts: Any) -> None:
        """Record versions and sources of the run, without names of people or machines.

        The working folder is recorded, from the run's on, if the run does not lie in it.
        """
        here, there = Path.cwd().resolve(), self.path.resolve()
        if not there.is_relative_to(here):
            facts["working_folder"] = os.path.relpath(here, there)
        storage.commit_json(self.path / build.PROVENANCE_NAME, {**versions(), **facts})


def open_run(path: Path | str) -> Run:
    """Open a fitted run; see :class:`Run`.

    Raises:
        InputError: If there is no fitted run, or it is damaged.
        IncompatibleError: If it needs another version.
    """
    run = Run(path)
    _ = run.model
    return run
