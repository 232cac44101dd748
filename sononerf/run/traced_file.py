# SPDX-License-Identifier: MIT
"""The surface that a run traces echoes off, with their gain and weight, in a file."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import safetensors.torch
import torch
import trimesh
from safetensors import SafetensorError, safe_open

from sononerf import storage
from sononerf.errors import InputError
from sononerf.evaluation.traced import Traced
from sononerf.field.checkpoint_io import model_checksum

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
            found = {name: opened.get_tensor(name).numpy() for name in opened.keys()}
            model = (opened.metadata() or {}).get("model")
        if model != model_checksum(path):
            return None
        faces, vertices = found["faces"], found["vertices"]
        gain, weight = found["gain_db"], found["weight"]
        if not (np.isfinite(vertices).all() and np.isfinite(gain).all()):
            raise ValueError("numbers that are not finite")
        if not ((weight >= 0) & (weight <= 1)).all():
            raise ValueError("weights outside 0 to 1")
        if len(faces) and not 0 <= int(faces.min()) <= int(faces.max()) < len(vertices):
            raise ValueError("a triangle names a vertex that is not there")
        fault = found["fault"].tobytes().decode()
        half = found.get("half_db")
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
