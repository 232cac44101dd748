# SPDX-License-Identifier: MIT
"""Settings into objects: head, simulator, true surface, fitted model; what a run says of itself."""

from __future__ import annotations

import importlib.metadata
import logging
import math
import os
import platform
from collections.abc import Iterable, Iterator, Mapping
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

import numpy as np
import safetensors.torch
import torch
import trimesh
from numpy.typing import ArrayLike
from safetensors import SafetensorError, safe_open

from sononerf import __version__, storage
from sononerf.echoes.echoes import stated_head
from sononerf.echoes.free_space import EchoHull
from sononerf.echoes.store import EnsembleStore
from sononerf.errors import IncompatibleError, InputError, SettingsError, SonoNerfError
from sononerf.evaluation.traced import Traced
from sononerf.field.checkpoint_io import DESCRIPTION_NAME, load_weights, model_checksum
from sononerf.field.module import EchoModule
from sononerf.geometry.poses import KEYS, Frame
from sononerf.head.call import attached
from sononerf.head.head import Head
from sononerf.run.simulate import head_of
from sononerf.scene import mesh_file
from sononerf.scene.scene import Scene, check_surface, load_scene
from sononerf.settings.loading import faults_of, validate_settings
from sononerf.settings.schema import HEAD_SECTIONS, Settings
from sononerf.settings.sections import LENGTHS

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
PROVENANCE_NAME = "provenance.json"
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
    """Complete the settings from the store, if the echoes come from one, and from the call."""
    if settings.scene is not None or settings.data.store is None:
        return settings.model_copy(update={"spectrogram": head_of(settings).spectrogram})
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


def located(settings: Settings, run: Path) -> Settings:
    """Return the settings with the paths of files that are there, whatever the working folder is.

    Paths that are not there from the working folder are tried from those above the run, and from
    the one of the fit.
    """
    file = run / PROVENANCE_NAME
    facts = storage.read_json(file) if file.is_file() else {}
    above = str(facts.get("working_folder", "")) if isinstance(facts, dict) else ""
    bases = [*run.absolute().parents, run.absolute() / above]

    def there(path: Path) -> Path:
        return (
            path if path.exists() else next((b / path for b in bases if (b / path).exists()), path)
        )

    def within(options: Any) -> Any:
        if isinstance(options, list):
            return [within(one) for one in options]
        if not isinstance(options, dict):
            return options
        return {
            key: str(there(Path(one))) if key == "path" and isinstance(one, str) else within(one)
            for key, one in options.items()
        }

    data, evaluation, scene = settings.data, settings.evaluation, settings.scene
    changed: dict[str, Any] = {}
    if data.store is not None:
        changed["data"] = data.model_copy(update={"store": there(data.store)})
    if evaluation.truth is not None:
        truth = there(evaluation.truth)
        changed["evaluation"] = evaluation.model_copy(update={"truth": truth})
    if scene is not None:
        changed["scene"] = scene.model_copy(update={"options": within(scene.options)})
    return settings.model_copy(update=changed)


def module_for(
    settings: Settings, head: Head, region: ArrayLike | None, reference: float
) -> EchoModule:
    """Return an unfitted module that settings describe. In: region ((2, 3), m)."""
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

Unit = Literal["m", "cm", "mm"]


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
    try:
        file = mesh_file.read_mesh(path)
        mesh = trimesh.Trimesh(LENGTHS[unit] * file.vertices, file.faces, process=False)
        check_surface(mesh)  # before vertices are merged, which drops those that are no numbers
        mesh.merge_vertices()
        return Scene(mesh).mesh  # warns of its faults
    except InputError as error:
        raise InputError(f"evaluation.truth: {error}") from None


@dataclass(frozen=True)
class Model:
    """A fitted field as its run's two files describe it."""

    module: EchoModule
    hull: EchoHull
    settings: Settings
    echo_hash: str


def read_model(path: Path) -> Model:
    """Read a fitted field from ``model.safetensors`` and ``model.json`` alone; runs no code."""
    if not (path / DESCRIPTION_NAME).is_file():
        raise InputError(
            f"{path}: no fitted run (no {DESCRIPTION_NAME}); make or finish one with `sononerf fit`"
        )
    state, description = load_weights(path)
    try:
        settings = validate_settings(description["settings"], str(path / "model.json"))
        reference = float(description["reference"])
        echoes = str(description["echo_hash"])
        region = state["field.region"]
        hull = _hull(state)
    except (KeyError, TypeError, ValueError) as error:
        raise InputError(f"{path}: incomplete ({error}); repeat the fit") from None
    except SettingsError as error:
        raise IncompatibleError(f"settings of another version: {error}") from None
    if not 0.0 < reference < math.inf:  # JSON as Python reads it knows NaN
        raise InputError(
            f"{path / DESCRIPTION_NAME}: reference is {reference}, expected a finite number above "
            "0; fetch the run again, or repeat the fit with --overwrite"
        )
    settings = located(with_attached(settings, path), path)
    head = head_of(settings)
    hull = replace(hull, plane=head.plane)
    module = module_for(settings, head, region, reference)
    for part, prefix in ((module.field, "field."), (module.renderer, "renderer.")):
        own = {k.removeprefix(prefix): v for k, v in state.items() if k.startswith(prefix)}
        try:
            part.load_state_dict(own)
        except RuntimeError as error:
            raise IncompatibleError(
                f"{path / 'model.safetensors'}: does not fit {settings.field.kind} and "
                f"{settings.renderer.kind} of this version: {str(error).splitlines()[-1].strip()}"
            ) from None
    module.eval()
    return Model(module, hull, settings, echoes)


def _hull(state: dict[str, torch.Tensor]) -> EchoHull:
    read: dict[str, Any] = {
        name: state[f"hull.{name}"].double().numpy() for name in EchoHull.ARRAYS
    }
    return EchoHull(**{**read, "within": float(read["within"])})


def read_mesh(file: Path, command: str) -> trimesh.Trimesh:
    """Read the surface of a run; errors name the command that makes it."""
    if not file.is_file():
        raise InputError(f"{file}: there is no surface; make one with `{command}`")
    try:
        mesh = trimesh.load_mesh(file, file_type="ply")
    except Exception as error:  # the error of a damaged file depends on trimesh's reader
        raise InputError(f"{file}: damaged ({error}); reconstruct again") from error
    if not isinstance(mesh, trimesh.Trimesh) or not len(mesh.faces):
        raise InputError(f"{file}: holds no surface; reconstruct again")
    return mesh


NAME = "traced.safetensors"


def save_traced(path: Path, traced: Traced) -> None:
    """Write the traced surface of a run, with its gain and weight."""
    tensors = {
        "vertices": torch.as_tensor(np.array(traced.mesh.vertices, dtype=np.float64)),
        "faces": torch.as_tensor(np.array(traced.mesh.faces, dtype=np.int64)),
        "gain_db": torch.as_tensor(traced.gain_db),
        "weight": torch.as_tensor(traced.weight),
        # Not in the metadata: several entries are written in any order, and the file differs.
        "fault": torch.tensor(list(traced.fault.encode()), dtype=torch.uint8),
    }
    if traced.half_db is not None:
        tensors["half_db"] = torch.as_tensor(traced.half_db)
    data = safetensors.torch.save(tensors, metadata={"model": model_checksum(path)})
    storage.commit_bytes(path / NAME, data)


def load_traced(path: Path) -> Traced | None:
    """Read ``RUN/traced.safetensors``; None if there is none, or it belongs to another fit."""
    file = path / NAME
    if not file.is_file():
        return None
    try:
        with safe_open(str(file), "pt") as opened:
            arrays = {name: opened.get_tensor(name).numpy() for name in opened.keys()}
            model = (opened.metadata() or {}).get("model")
        if model != model_checksum(path):
            return None
        faces, vertices = arrays["faces"], arrays["vertices"]
        gain, weight = arrays["gain_db"], arrays["weight"]
        if not (np.isfinite(vertices).all() and np.isfinite(gain).all()):
            raise ValueError("numbers that are not finite")
        if not ((weight >= 0) & (weight <= 1)).all():
            raise ValueError("weights outside 0 to 1")
        if len(faces) and not 0 <= int(faces.min()) <= int(faces.max()) < len(vertices):
            raise ValueError("a triangle names a vertex that is not there")
        fault = arrays["fault"].tobytes().decode()
        half = arrays.get("half_db")
        if half is not None and not (np.isfinite(half) & (half >= 0)).all():
            raise ValueError("intervals that are negative or not finite")
        mesh = trimesh.Trimesh(vertices, faces, process=False)
        return Traced(mesh, gain, weight, fault, half)
    except (SafetensorError, KeyError, ValueError, OSError) as error:
        raise InputError(
            f"{file}: damaged ({error}); remove it, and `sononerf fit` makes it again"
        ) from None


def same_mesh(one: trimesh.Trimesh, two: trimesh.Trimesh) -> bool:
    """Return True if two meshes have the same vertices and triangles."""
    return np.array_equal(one.vertices, two.vertices) and np.array_equal(one.faces, two.faces)
