# SPDX-License-Identifier: MIT
"""Settings into objects: head, simulator, true surface; and what a run states about itself."""

from __future__ import annotations

import importlib.metadata
import logging
import os
import platform
from collections.abc import Iterable, Iterator, Mapping
from contextlib import ExitStack, contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

import numpy as np
import trimesh
from numpy.typing import ArrayLike

from sononerf import storage
from sononerf.echoes.echoes import stated_head
from sononerf.echoes.store import EnsembleStore
from sononerf.errors import IncompatibleError, InputError, SonoNerfError
from sononerf.field.module import EchoModule
from sononerf.geometry.frame import KEYS, Frame
from sononerf.head.call_file import attached
from sononerf.head.head import Head
from sononerf.scene.scene import Scene, load_scene
from sononerf.settings.import_schema import LENGTHS
from sononerf.settings.loading import faults_of, validate_settings
from sononerf.settings.schema import HEAD_SECTIONS, Settings
from sononerf.simulation.simulator import Simulator
from sononerf.version import __version__

if TYPE_CHECKING:
    from sononerf.run.run import Run

FREE_KEYS = (
    "data.store",
    "data.workers",
    "data.memory_bytes",
    "evaluation",
    "fit.checkpoint_seconds",
)
"""Settings that may change between two calls of one run: they do not change the fit."""
POSE_KEYS = (
    *("length", "angle", "frame", "axes", "head_axes", "positive_pitch", "quaternion", "look_at"),
    "turntable",
)
"""Settings of an import that say how a table of poses is to be read."""
RECORDED = ("torch", "lightning", "numpy", "scipy", "trimesh", "manifold3d", "embreex", "zarr")


def flat(data: dict[str, Any], prefix: str = "") -> dict[str, Any]:
    """Return nested data by dotted keys."""
    flattened: dict[str, Any] = {}
    for key, value in data.items():
        name = f"{prefix}{key}"
        if isinstance(value, dict) and value:
            flattened.update(flat(value, f"{name}."))
        else:
            flattened[name] = value
    return flattened


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


def versions() -> dict[str, Any]:
    """Return versions and kind of machine, without names of people, machines or folders."""
    return {
        "sononerf": __version__,
        "python": platform.python_version(),
        "system": platform.system(),
        "machine": platform.machine(),
        "cores": os.cpu_count(),
        "packages": {name: importlib.metadata.version(name) for name in RECORDED if _has(name)},
    }


def _has(name: str) -> bool:
    try:
        importlib.metadata.version(name)
    except importlib.metadata.PackageNotFoundError:
        return False
    return True


OWN_KEYS = ("spectrogram.dynamic_range_db",)
"""Keys of these sections that an experiment may choose: they do not describe the echoes."""


def with_store(settings: Settings) -> Settings:
    """Complete the settings from the store, if the echoes come from one."""
    if settings.scene is not None or settings.data.store is None:
        return settings
    path = settings.data.store
    stated = stated_head(EnsembleStore.open(path))
    resolved = settings.plain()
    different = []
    for section in HEAD_SECTIONS:
        # The store's own values are checked like a file's; a newer key takes its default.
        given = getattr(settings, section)
        for key in given.model_fields_set:
            name = f"{section}.{key}"
            if name in OWN_KEYS:
                stated[section][key] = resolved[section][key]
            elif key in stated[section] and stated[section][key] != resolved[section][key]:
                different.append(
                    f"{name}: found {resolved[section][key]}, the store has {stated[section][key]}"
                )
        resolved[section] = stated[section]
    if different:
        raise IncompatibleError(
            f"{path}: the settings contradict the store; leave these keys out: "
            + "; ".join(sorted(different))
        )
    return with_attached(validate_settings(resolved, settings.source or str(path)), path)


def with_attached(settings: Settings, folder: Path) -> Settings:
    """Return the settings with the paths of copies in a folder, where there are copies."""
    found = attached(settings, folder)
    return settings.model_copy(update=found) if found else settings


def head_of(settings: Settings) -> Head:
    """Return the head that settings describe."""
    return Head(
        ears=settings.ears,
        call=settings.call,
        air=settings.air,
        analysis=settings.spectrogram,
        noise=settings.noise,
        support=settings.support,
    )


def module_for(
    settings: Settings, head: Head, region: ArrayLike | None, reference: float
) -> EchoModule:
    """Return an unfitted module that settings describe.

    In: region ((2, 3), m).
    """
    with faults_of(settings.source):
        return EchoModule(
            settings.field.kind,
            settings.renderer.kind,
            head=head,
            region=((-0.05,) * 3, (0.05,) * 3) if region is None else region,
            reference=reference,
            field_options=settings.field.options,
            renderer_options=settings.renderer.options,
            options=settings.fit,
        )


def simulator_of(scene: Scene, settings: Settings) -> Simulator:
    """Return the simulator of a scene that settings describe; see :class:`Simulator`."""
    return Simulator(scene, head_of(settings), settings.simulation)


@contextmanager
def results_folder(folder: Path) -> Iterator[None]:
    """Make a folder for results; remove it afterwards if it is empty."""
    if any((folder / name).exists() for name in ("config.yaml", "model.json")):
        raise InputError(f"{folder}: is the folder of a run; give --output a folder of its own")
    created = storage.probe_writable(folder)
    try:
        yield
    finally:
        storage.remove_if_empty(created)


@contextmanager
def locked(runs: Iterable[Run], output: Path) -> Iterator[None]:
    """Hold those runs whose folder a file goes into; see :meth:`Run.locked`."""
    with ExitStack() as stack:
        for run in runs:
            stack.enter_context(run.locked(output))
        yield


logger = logging.getLogger("sononerf")

MOST_BYTES = 2_000_000_000
"""Largest file that is read, bytes."""
Unit = Literal["m", "cm", "mm"]
KINDS = (".ply", ".stl", ".obj", ".off", ".glb")


def true_scene(settings: Settings) -> Scene | None:
    """Return the scene of a run; None without one, and with a warning if it cannot be loaded."""
    if settings.scene is None:
        return None
    try:
        return load_scene(settings.scene.name, settings.scene.options)
    except SonoNerfError as error:
        logger.warning(
            "the true surface is unknown: %s; evaluation.truth=FILE names another file of it", error
        )
        return None


def true_mesh(
    settings: Settings, stated: Mapping[str, Any] | None = None
) -> trimesh.Trimesh | None:
    """Return ``evaluation.truth``, or else the scene's own surface; None where neither is known."""
    if settings.evaluation.truth is not None:
        chosen = settings.evaluation
        frame = Frame.of(stated or {}, chosen.frame)
        return frame.to_world(read_truth(settings.evaluation.truth, chosen.unit))
    scene = true_scene(settings)
    return None if scene is None else scene.mesh


def read_truth(path: Path, unit: Unit = "m") -> trimesh.Trimesh:
    """Read a true surface from a file; return it in metres."""
    if path.suffix.lower() not in KINDS:
        raise InputError(f"{path}: evaluation.truth: expected one of {', '.join(KINDS)}")
    if not path.is_file():
        raise InputError(f"{path}: evaluation.truth: no such file")
    if path.stat().st_size > MOST_BYTES:
        raise InputError(f"{path}: evaluation.truth: larger than {MOST_BYTES} bytes")
    try:
        mesh = trimesh.load_mesh(path)
        if isinstance(mesh, trimesh.Scene):
            mesh = mesh.to_mesh()
        good = isinstance(mesh, trimesh.Trimesh) and len(mesh.faces) > 0
        good = good and mesh.vertices.shape[1:] == (3,) and bool(np.isfinite(mesh.vertices).all())
    except Exception as error:  # the error of a damaged file depends on trimesh's reader
        raise InputError(f"{path}: evaluation.truth: damaged ({error})") from error
    if not good:
        raise InputError(f"{path}: evaluation.truth: holds no surface of finite triangles")
    mesh.apply_scale(LENGTHS[unit])
    return mesh
