# SPDX-License-Identifier: MIT
"""Lightning's checkpoints through the one write path, and a fitted field's weights.

Lightning's own save is neither atomic across file systems nor durable.
"""

from __future__ import annotations

import hashlib
from pathlib import Path
from typing import Any, BinaryIO

import safetensors.torch
import torch
from lightning.pytorch.plugins.io import CheckpointIO
from torch import Tensor

from sononerf import storage
from sononerf.errors import IncompatibleError, InputError


def _local(path: Any) -> Path:
    text = str(path)
    if "://" in text or "::" in text:
        raise InputError(f"{text}: a checkpoint is a local file; URLs are not opened")
    return Path(text)


class DurableCheckpointIO(CheckpointIO):
    """Saves atomically and durably, loads data and never code."""

    def save_checkpoint(
        self,
        checkpoint: dict[str, Any],
        path: Any,
        storage_options: Any = None,  # noqa: ARG002 - Lightning's signature
    ) -> None:
        """Write a checkpoint."""
        target = _local(path)

        def write(file: BinaryIO) -> None:
            try:
                torch.save(checkpoint, file)
            except RuntimeError as error:
                # torch hides the operating system's refusal behind its own bookkeeping's.
                if isinstance(error.__context__, OSError):
                    raise error.__context__ from None
                raise

        storage.commit(target, write)

    def load_checkpoint(
        self,
        path: Any,
        map_location: Any = None,  # noqa: ARG002 - Lightning's signature
        weights_only: bool | None = None,  # noqa: ARG002
    ) -> dict[str, Any]:
        """Read a checkpoint to the CPU.

        ``map_location`` and ``weights_only`` are Lightning's; they are ignored: a checkpoint is
        always loaded to the CPU and never runs code.
        """
        target = _local(path)
        try:
            content = torch.load(target, map_location="cpu", weights_only=True)
        except Exception as error:  # a damaged archive raises half a dozen kinds
            first = str(error).partition("\n")[0]
            raise InputError(
                f"{target}: no checkpoint of plain data: {first}; start the fit again with "
                "--overwrite"
            ) from error
        if not isinstance(content, dict):
            raise InputError(f"{target}: holds {type(content).__name__}, expected a checkpoint")
        _refuse_nan(target, content.get("state_dict"))
        return content

    def remove_checkpoint(self, path: Any) -> None:
        """Remove a checkpoint."""
        storage.remove_file(_local(path))


SCHEMA_VERSION = 1
WEIGHTS_NAME = "model.safetensors"
DESCRIPTION_NAME = "model.json"


def save_weights(folder: Path, state: dict[str, Tensor], description: dict[str, Any]) -> None:
    """Write ``model.safetensors`` and, last, the ``model.json`` that vouches for it."""
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
    """Read a fitted field's weights, on the CPU, and their description; runs no code."""
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
    _refuse_nan(weights, state)
    return state, description


def _refuse_nan(path: Path, state: Any) -> None:
    """Refuse weights that hold NaN: all that is rendered with them would be NaN."""
    for name, values in state.items() if isinstance(state, dict) else ():
        if isinstance(values, Tensor) and bool(torch.isnan(values).any()):
            raise InputError(f"{path}: {name} holds NaN; repeat the fit with --overwrite")
