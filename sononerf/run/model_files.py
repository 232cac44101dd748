# SPDX-License-Identifier: MIT
"""The two files of a fitted field, and the surface that its echoes are traced off, in a third."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import safetensors.torch
import torch
import trimesh
from safetensors import SafetensorError, safe_open

from sononerf import storage
from sononerf.echoes.free_space import EchoHull
from sononerf.errors import IncompatibleError, InputError, SettingsError
from sononerf.evaluation.traced import Traced
from sononerf.field.checkpoint_io import DESCRIPTION_NAME, load_weights, model_checksum
from sononerf.field.module import EchoModule
from sononerf.run.build import head_of, module_for, with_attached
from sononerf.settings.loading import validate_settings
from sononerf.settings.schema import Settings


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
    settings = with_attached(settings, path)
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
    """Return whether two meshes have the same vertices and triangles."""
    return np.array_equal(one.vertices, two.vertices) and np.array_equal(one.faces, two.faces)
