# SPDX-License-Identifier: MIT
"""A run on disk: its lock, its stages, and its parts, each of which is loaded once."""

from __future__ import annotations

import importlib.metadata
import os
import platform
import shutil
from collections.abc import Iterable, Iterator, Mapping
from contextlib import ExitStack, contextmanager
from dataclasses import replace
from functools import cached_property
from pathlib import Path
from typing import Any, Literal

import numpy as np
import trimesh

from sononerf import __version__, checksums, locks, storage
from sononerf.echoes.echoes import Echoes
from sononerf.errors import IncompatibleError, InputError
from sononerf.evaluation.traced import Traced
from sononerf.field.checkpoint_io import DESCRIPTION_NAME
from sononerf.geometry.frame import KEYS, Frame, FrameName
from sononerf.head.attached import attach
from sononerf.run.fitted import Fitted, echoes_of, load_fitted, load_traced, save_traced
from sononerf.settings.loading import dump_yaml, read_yaml, validate_settings
from sononerf.settings.schema import Settings

METRICS_SCHEMA = 1
FREE_KEYS = (
    "data.store",
    "data.workers",
    "data.memory_bytes",
    "evaluation",
    "fit.checkpoint_seconds",
)
"""Settings that may change between two calls of one run: they do not change the fit."""
Stage = Literal["fit", "surface", "traced", "prediction", "evaluation"]
STAGES: tuple[Stage, ...] = ("fit", "surface", "traced", "prediction", "evaluation")
"""Stages of a run, in order: the fit; the reconstruction; gain and weight of echoes traced off it;
the prediction of held-out poses; the comparison with the true surface and the baselines."""
POSE_KEYS = (
    *("length", "angle", "frame", "axes", "head_axes", "positive_pitch", "quaternion", "look_at"),
    "turntable",
)
"""Settings of an import that say how a table of poses is to be read."""
RECORDED = ("torch", "lightning", "numpy", "scipy", "trimesh", "manifold3d", "embreex", "zarr")


def flat(data: dict[str, Any], prefix: str = "") -> dict[str, Any]:
    """Return nested data by dotted keys."""
    found: dict[str, Any] = {}
    for key, value in data.items():
        name = f"{prefix}{key}"
        if isinstance(value, dict) and value:
            found.update(flat(value, f"{name}."))
        else:
            found[name] = value
    return found


def differing_keys(old: Settings, new: Settings) -> list[str]:
    """Return the dotted keys in which two experiments differ, without those that move nothing."""
    first, second = flat(old.plain()), flat(new.plain())
    return [
        key
        for key in sorted(first.keys() | second.keys())
        if first.get(key) != second.get(key)
        and not any(key == free or key.startswith(f"{free}.") for free in FREE_KEYS)
    ]


def stated_frame(attributes: Mapping[str, Any]) -> dict[str, Any]:
    """Return the frame of the original poses, from the attributes of a store."""
    facts = {key: attributes.get(key) for key in (*KEYS, "origin")}
    given = attributes.get("import") or {}
    return {**facts, "poses_as": {key: given[key] for key in POSE_KEYS if key in given}}


class RunFolder:
    """One run on disk.

    Args:
        path: Its folder.
    """

    def __init__(self, path: Path) -> None:
        self.path = path
        self.config = path / "config.yaml"
        self.metrics = path / "metrics.json"
        self.checkpoint = path / "checkpoints" / "last.ckpt"
        self.reconstruction = path / "reconstruction"
        self._locks = 0
        self._kept: Traced | None = None

    @classmethod
    def of(cls, run: Path | RunFolder) -> RunFolder:
        """Return the run of a path, or the same run."""
        return run if isinstance(run, RunFolder) else cls(run)

    @contextmanager
    def locked(self, output: Path | None = None) -> Iterator[None]:
        """Hold the run against other processes; within one process it can be held repeatedly.

        Args:
            output: Folder of the results; outside the run's folder no lock is needed.

        Raises:
            LockedError: If another process holds the run.
            StorageError: If the lock file cannot be written.
        """
        elsewhere = output is not None and not output.resolve().is_relative_to(self.path.resolve())
        if self._locks or elsewhere:
            yield
            return
        with locks.lock(self.path), checksums.recorded(self.path):
            self._locks += 1
            try:
                yield
            finally:
                self._locks -= 1

    @cached_property
    def fitted(self) -> Fitted:
        """The fitted field; raises as :func:`sononerf.run.fitted.load_fitted`."""
        return load_fitted(self.path)

    @cached_property
    def echoes(self) -> Echoes:
        """Echoes that were fitted; raises as :func:`sononerf.run.fitted.echoes_of`."""
        return echoes_of(self.fitted)

    @property
    def has_heldout(self) -> bool:
        """Whether poses were held out of the fit."""
        settings = self.fitted.settings
        if settings.scene is not None:
            return settings.poses.heldout > 0
        return len(self.echoes.store.indices("test")) > 0

    @property
    def provenance(self) -> dict[str, Any]:
        """Versions, machine and sources of the run; empty if the file is missing."""
        file = self.path / "provenance.json"
        self.require_recorded(file, "fetch the run again, or repeat the fit with --overwrite")
        found = storage.read_json(file) if file.is_file() else {}
        return found if isinstance(found, dict) else {}

    def require_recorded(self, file: Path, remedy: str) -> None:
        """Refuse a damaged file; see :func:`sononerf.checksums.require_recorded`."""
        checksums.require_recorded(self.path, file, remedy)

    def frame(self, name: FrameName = "auto") -> Frame:
        """Return the frame of that name; see :meth:`sononerf.geometry.frame.Frame.of`."""
        return Frame.of(self.provenance, name)

    def mesh(self) -> trimesh.Trimesh:
        """Read the reconstructed surface.

        Raises:
            InputError: If it is missing, damaged or empty.
        """
        file = self.reconstruction / "mesh.ply"
        if not file.is_file():
            raise InputError(
                f"{file}: there is no surface; make one with `sononerf reconstruct {self.path}`"
            )
        self.require_recorded(file, f"reconstruct again with `sononerf reconstruct {self.path}`")
        try:
            mesh = trimesh.load_mesh(file, file_type="ply")
        except Exception as error:  # the error of a damaged file depends on trimesh's reader
            raise InputError(f"{file}: damaged ({error}); reconstruct again") from error
        if not isinstance(mesh, trimesh.Trimesh) or not len(mesh.faces):
            raise InputError(f"{file}: holds no surface; reconstruct again")
        return mesh

    @property
    def read_out(self) -> dict[str, Any]:
        """Settings with which the reconstructed surface was read out.

        Raises:
            InputError: If it is missing or damaged.
        """
        file = self.reconstruction / "read_out.json"
        again = f"reconstruct again with `sononerf reconstruct {self.path}`"
        self.require_recorded(file, again)
        found = storage.read_json(file)
        if not isinstance(found, dict):
            raise InputError(f"{file}: damaged; {again}")
        return found

    def traced(self) -> Traced | None:
        """Return the surface that echoes are traced off, and their weight; None without them."""
        found, kept = load_traced(self.path), self._kept
        if found is None or kept is None or not _same(found.mesh, kept.mesh):
            return found
        return replace(found, simulator=kept.simulator)

    def keep_traced(self, traced: Traced) -> None:
        """Write the traced surface, with its gain and weight."""
        save_traced(self.path, traced)
        self._kept = traced

    def _traces_its_mesh(self) -> bool:
        """Return whether the traced surface is that of the reconstruction."""
        try:
            traced, mesh = self.traced(), self.mesh()
        except InputError:
            return False
        return traced is not None and _same(traced.mesh, mesh)

    def is_done(self, stage: Stage) -> bool:
        """Return whether a stage came to its end, with the results of the stages before it."""
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
        """Return the settings of a run that is there.

        Raises:
            InputError: If there is none.
        """
        if not self.config.is_file():
            raise InputError(f"{self.path}: no run (no config.yaml); make one with `sononerf fit`")
        return validate_settings(read_yaml(self.config), str(self.config))

    def check(self, settings: Settings) -> None:
        """Make sure that the folder is free, or holds a run of the same settings.

        Raises:
            IncompatibleError: If the folder holds a run of other settings.
            InputError: If the folder holds something else.
        """
        if self.config.is_file():
            different = differing_keys(self.open(), settings)
            if different:
                raise IncompatibleError(
                    f"{self.path}: holds a run of other settings ({', '.join(different[:5])}"
                    f"{', ...' if len(different) > 5 else ''}); choose another --output, or "
                    "--overwrite to move it aside"
                )
            return
        self._refuse_foreign()

    def prolong(self, settings: Settings) -> None:
        """Take over a larger number of epochs, if nothing else differs.

        Args:
            settings: Settings of the fit that is asked for.
        """
        if not self.config.is_file():
            return
        old = self.open()
        if differing_keys(old, settings) == ["fit.epochs"] and settings.fit.epochs > old.fit.epochs:
            storage.remove_file(self.path / DESCRIPTION_NAME)
            self.begin("surface")
            self.begin("traced")
            storage.commit_text(self.config, dump_yaml(settings))

    def _refuse_foreign(self) -> None:
        # Checksums are recorded before the first file is there.
        ours = checksums.NAME
        foreign = [p.name for p in self.path.iterdir() if p.name[0] != "." and p.name != ours]
        if foreign:
            raise InputError(
                f"{self.path}: holds {sorted(foreign)[0]!r} and is no run; choose another --output"
            )

    def begin_fit(self, settings: Settings) -> None:
        """Write the settings of a new run, or make sure that an old one has the same.

        Raises:
            IncompatibleError: If the folder holds a run of other settings.
            InputError: If the folder holds something else.
        """
        self.check(settings)
        if not self.config.is_file():
            attach(settings, self.path)
            storage.commit_text(self.config, dump_yaml(settings))

    def move_aside(self) -> Path | None:
        """Rename the folder so that a new run can take its place; nothing is deleted.

        Raises:
            InputError: If the folder holds something that is no run.
            LockedError: If another process works in it.
            StorageError: If it cannot be renamed.
        """
        if not self.path.exists():
            return None
        path = self.path.resolve()
        number = 1
        while (aside := path.with_name(f"{path.name}.old-{number}")).exists():
            number += 1
        with locks.lock(path):
            if not self.config.is_file():
                self._refuse_foreign()
            try:
                path.rename(aside)
            except OSError as error:
                raise storage.storage_error("cannot be moved aside", path, error) from error
        return aside

    def read_metrics(self) -> dict[str, Any]:
        """Return the present content of ``metrics.json``."""
        if not self.metrics.is_file():
            return {"schema": METRICS_SCHEMA}
        self.require_recorded(self.metrics, "remove it, and the same fit command goes on")
        metrics = storage.read_json(self.metrics)
        if not isinstance(metrics, dict):
            raise InputError(f"{self.metrics}: holds no metrics; remove it and evaluate again")
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
            storage.commit_json(self.metrics, metrics)

    def drop_metrics(self, section: str) -> None:
        """Take one section out of ``metrics.json``, where it is there."""
        with self.locked():
            metrics = self.read_metrics()
            if section in metrics:
                del metrics[section]
                storage.commit_json(self.metrics, metrics)

    def write_provenance(self, **facts: Any) -> None:
        """Record versions and sources of the run, without names of people, machines or folders."""
        storage.commit_json(
            self.path / "provenance.json",
            {
                "sononerf": __version__,
                "python": platform.python_version(),
                "system": platform.system(),
                "machine": platform.machine(),
                "cores": os.cpu_count(),
                "packages": {
                    name: importlib.metadata.version(name) for name in RECORDED if _has(name)
                },
                **facts,
            },
        )

    def clear_previews(self) -> None:
        """Remove the previews of a fit that starts anew."""
        shutil.rmtree(self.path / "epochs", ignore_errors=True)


@contextmanager
def locked(runs: Iterable[RunFolder], output: Path) -> Iterator[None]:
    """Hold those runs whose folder a file goes into; see :meth:`RunFolder.locked`."""
    with ExitStack() as stack:
        for run in runs:
            stack.enter_context(run.locked(output))
        yield


def _same(one: trimesh.Trimesh, two: trimesh.Trimesh) -> bool:
    """Return whether two meshes have the same vertices and triangles."""
    return np.array_equal(one.vertices, two.vertices) and np.array_equal(one.faces, two.faces)


def _has(name: str) -> bool:
    try:
        importlib.metadata.version(name)
    except importlib.metadata.PackageNotFoundError:
        return False
    return True
