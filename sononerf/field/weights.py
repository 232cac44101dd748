# SPDX-License-Identifier: MIT
"""A fitted field as it is handed on: weights that are data, never code, and what they are."""

from __future__ import annotations

import hashlib
from pathlib import Path
from typing import Any

import safetensors.torch
from torch import Tensor

from sononerf import storage
from sononerf.errors import IncompatibleError, InputError

SCHEMA_VERSION = 1
WEIGHTS_NAME = "model.safetensors"
DESCRIPTION_NAME = "model.json"


def save_weights(folder: Path, state: dict[str, Tensor], description: dict[str, Any]) -> None:
    """Write ``model.safetensors`` and, last, the ``model.json`` that vouches for it.

    Parameters
    ----------
    folder : Path
        The run.
    state : dict of Tensor
        Parameters and buffers by name, on any device.
    description : dict
        Plain data; ``schema_version`` and ``sha256`` are added.
    """
    # Views of one storage are refused by the format; each tensor goes with its own bytes.
    own = {name: tensor.detach().clone().contiguous() for name, tensor in state.items()}
    data = safetensors.torch.save(own)
    storage.commit_bytes(folder / WEIGHTS_NAME, data)
    described = {
        **description,
        "schema_version": SCHEMA_VERSION,
        "sha256": hashlib.sha256(data).hexdigest(),
    }
    storage.commit_json(folder / DESCRIPTION_NAME, described)


def model_checksum(folder: Path) -> str:
    """Return the SHA-256 of the field that a run's folder holds, as its description says."""
    return str(storage.read_json(folder / DESCRIPTION_NAME)["sha256"])


def load_weights(folder: Path) -> tuple[dict[str, Tensor], dict[str, Any]]:
    """Read a fitted field's weights, on the CPU, and their description; runs no code.

    Raises
    ------
    InputError
        If a file is missing or damaged.
    IncompatibleError
        If a newer sononerf wrote it.
    """
    path = folder / DESCRIPTION_NAME
    description = storage.read_json(path)
    version = description.get("schema_version") if isinstance(description, dict) else None
    if not isinstance(version, int) or isinstance(version, bool) or version < 1:
        raise InputError(f"{path}: no description of a fitted field (schema_version {version!r})")
    if version > SCHEMA_VERSION:
        raise IncompatibleError(
            f"{path}: schema_version {version}, this sononerf reads up to {SCHEMA_VERSION}; "
            "install a newer sononerf"
        )
    weights = folder / WEIGHTS_NAME
    try:
        data = weights.read_bytes()
    except OSError as error:
        raise InputError(f"{weights}: cannot be read ({error.strerror})") from None
    # Read whole, then checked, then parsed: the format has no checksum of its own.
    if hashlib.sha256(data).hexdigest() != description.get("sha256"):
        raise InputError(
            f"{weights}: damaged, or not the weights that {DESCRIPTION_NAME} describes; "
            "fetch both again, or repeat the fit with --overwrite"
        )
    try:
        state = safetensors.torch.load(data)
    except Exception as error:  # the reader's errors have no common base
        raise InputError(f"{weights}: no safetensors file ({error})") from error
    return state, description
