# SPDX-License-Identifier: MIT
"""What a run's folder holds, and which of it is whose."""

from __future__ import annotations

import importlib.metadata
import os
import platform
import shutil
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from sononerf import __version__, storage
from sononerf.errors import IncompatibleError, InputError
from sononerf.field.weights import DESCRIPTION_NAME
from sononerf.run.attached import attach
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
"""What may change between two calls of one run: it changes nothing that is fitted."""
RECORDED = ("torch", "lightning", "numpy", "scipy", "trimesh", "embreex", "zarr")


def _flat(data: dict[str, Any], prefix: str = "") -> dict[str, Any]:
    flat: dict[str, Any] = {}
    for key, value in data.items():
        name = f"{prefix}{key}"
        if isinstance(value, dict) and value:
            flat.update(_flat(value, f"{name}."))
        else:
            flat[name] = value
    return flat


@contextmanager
def results_folder(folder: Path) -> Iterator[None]:
    """Make a folder for results; if nothing comes into it, it is gone afterwards.

    Raises
    ------
    InputError
        If it is a run's own, in which results would lie among its files.
    StorageError
        If it cannot be created or written.
    """
    if any((folder / name).exists() for name in ("config.yaml", DESCRIPTION_NAME)):
        raise InputError(f"{folder}: is the folder of a run; give --output a folder of its own")
    created = storage.probe_writable(folder)
    try:
        yield
    finally:
        storage.remove_if_empty(created)


def differing_keys(old: Settings, new: Settings) -> list[str]:
    """Return the dotted keys in which two experiments differ, without those that move nothing."""
    first, second = _flat(old.plain()), _flat(new.plain())
    return [
        key
        for key in sorted(first.keys() | second.keys())
        if first.get(key) != second.get(key)
        and not any(key == free or key.startswith(f"{free}.") for free in FREE_KEYS)
    ]


class RunFolder:
    """One run on disk.

    Parameters
    ----------
    path : Path
        Its folder.
    """

    def __init__(self, path: Path) -> None:
        self.path = path
        self.config = path / "config.yaml"
        self.metrics = path / "metrics.json"
        self.checkpoint = path / "checkpoints" / "last.ckpt"

    def open(self) -> Settings:
        """Return the settings of a run that is there.

        Raises
        ------
        InputError
            If there is none.
        """
        if not self.config.is_file():
            raise InputError(f"{self.path}: no run (no config.yaml); make one with `sononerf fit`")
        return validate_settings(read_yaml(self.config), str(self.config))

    def check(self, settings: Settings) -> None:
        """Make sure that the folder is free, or holds a run of the same settings.

        Raises
        ------
        IncompatibleError
            If the folder holds a run of other settings.
        InputError
            If the folder holds something else.
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

    def _refuse_foreign(self) -> None:
        foreign = [p.name for p in self.path.iterdir() if not p.name.startswith(".")]
        if foreign:
            raise InputError(
                f"{self.path}: holds {sorted(foreign)[0]!r} and is no run; choose another --output"
            )

    def begin(self, settings: Settings) -> None:
        """Write the settings of a new run, or make sure that an old one has the same.

        Raises
        ------
        IncompatibleError
            If the folder holds a run of other settings.
        InputError
            If the folder holds something else.
        """
        self.check(settings)
        if not self.config.is_file():
            attach(settings, self.path)
            storage.commit_text(self.config, dump_yaml(settings))

    def move_aside(self) -> Path | None:
        """Rename the folder so that a new run can take its place; nothing is deleted.

        Raises
        ------
        InputError
            If the folder holds something that is no run.
        LockedError
            If another process works in it.
        StorageError
            If it cannot be renamed.
        """
        if not self.path.exists():
            return None
        path = self.path.resolve()
        number = 1
        while (aside := path.with_name(f"{path.name}.old-{number}")).exists():
            number += 1
        with storage.lock(path):
            if not self.config.is_file():
                self._refuse_foreign()
            try:
                path.rename(aside)
            except OSError as error:
                raise storage.storage_error("cannot be moved aside", path, error) from error
        return aside

    @property
    def is_fitted(self) -> bool:
        """Whether the fit came to its end."""
        return (self.path / "model.json").is_file()

    def read_metrics(self) -> dict[str, Any]:
        """Return what ``metrics.json`` holds so far."""
        if not self.metrics.is_file():
            return {"schema": METRICS_SCHEMA}
        metrics = storage.read_json(self.metrics)
        if not isinstance(metrics, dict):
            raise InputError(f"{self.metrics}: holds no metrics; remove it and evaluate again")
        return metrics

    def write_metrics(
        self, section: str, values: dict[str, Any] | None, *, merge: bool = False
    ) -> None:
        """Replace one section of ``metrics.json``; the others are left as they are."""
        metrics = self.read_metrics()
        if merge:
            values = {**(metrics.get(section) or {}), **(values or {})}
        storage.commit_json(self.metrics, {**metrics, "schema": METRICS_SCHEMA, section: values})

    def drop_metrics(self, section: str) -> None:
        """Take one section out of ``metrics.json``, where it is there."""
        metrics = self.read_metrics()
        if section in metrics:
            del metrics[section]
            storage.commit_json(self.metrics, metrics)

    def write_provenance(self, **facts: Any) -> None:
        """Record what the run was made with; no names of people, machines or folders."""
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


def _has(name: str) -> bool:
    try:
        importlib.metadata.version(name)
    except importlib.metadata.PackageNotFoundError:
        return False
    return True
