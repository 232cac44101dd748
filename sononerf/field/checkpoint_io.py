# SPDX-License-Identifier: MIT
"""Lightning's checkpoints through the one write path, checked before they are believed.

Lightning's own save is neither atomic across file systems nor durable, and ``torch.load`` does
not look at the checksums that a checkpoint, a zip archive, carries.
"""

from __future__ import annotations

import hashlib
import logging
import os
import zipfile
from pathlib import Path
from typing import Any, BinaryIO

import safetensors.torch
import torch
from lightning.pytorch.plugins.io import CheckpointIO
from torch import Tensor

from sononerf import storage
from sononerf.checksums import require_recorded
from sononerf.errors import IncompatibleError, InputError

_log = logging.getLogger("sononerf")


def _local(path: Any) -> Path:
    text = str(path)
    if "://" in text or "::" in text:
        raise InputError(f"{text}: a checkpoint is a local file; URLs are not opened")
    return Path(text)


def previous_of(path: Path) -> Path:
    """Return the name under which the checkpoint before the newest is kept."""
    return path.with_name(path.name + ".previous")


def _sign(file: BinaryIO) -> None:
    """Put the SHA-256 of a zip archive into its comment, where its own checksums do not reach.

    Those cover its members alone: one bit of the directory of members makes torch read other
        numbers.
    """
    file.flush()
    with Path(file.name).open("rb") as written:
        digest = hashlib.file_digest(written, "sha256").digest()
    file.seek(-2, os.SEEK_END)  # the length of the comment, 0 so far
    file.write(len(digest).to_bytes(2, "little") + digest)


def _signature(path: Path) -> tuple[bytes, bytes] | None:
    """Return the SHA-256 that an archive states and its actual one; None if it states none."""
    found = hashlib.sha256()
    tail = 2 + found.digest_size
    left = path.stat().st_size - tail
    with path.open("rb") as file:
        while left > 0 and (part := file.read(min(left, 1 << 20))):
            found.update(part)
            left -= len(part)
        end = file.read()
    if len(end) != tail or end[:2] != found.digest_size.to_bytes(2, "little"):
        return None
    found.update(bytes(2))
    return end[2:], found.digest()


def fault_of(path: Path) -> str | None:
    """Return the fault of a checkpoint's archive, or None if its checksums hold."""
    try:
        signature = _signature(path)
        if signature is not None:
            return None if signature[0] == signature[1] else "damaged (SHA-256)"
        with zipfile.ZipFile(path) as archive:
            broken = archive.testzip()
    except FileNotFoundError:
        return "no such file"
    except Exception as error:  # a damaged archive raises half a dozen kinds
        return f"damaged ({type(error).__name__}: {error})"
    return None if broken is None else f"damaged (checksum of {broken})"


class DurableCheckpointIO(CheckpointIO):
    """Saves atomically and durably, keeps the checkpoint before, loads data and never code."""

    def save_checkpoint(
        self,
        checkpoint: dict[str, Any],
        path: Any,
        storage_options: Any = None,  # noqa: ARG002 - Lightning's signature
    ) -> None:
        """Write a checkpoint; the one it replaces is kept as ``<name>.previous``.

        Raises:
            StorageError: If it cannot be written; the old one is then untouched.
            InputError: If the path is a URL.
        """
        target = _local(path)

        def write(file: BinaryIO) -> None:
            try:
                torch.save(checkpoint, file)
                _sign(file)
            except RuntimeError as error:
                # torch hides the operating system's refusal behind its own bookkeeping's.
                if isinstance(error.__context__, OSError):
                    raise error.__context__ from None
                raise

        # A damaged checkpoint must not take the place of a good one.
        keep = previous_of(target) if fault_of(target) is None else None
        storage.commit(target, write, previous=keep)

    def load_checkpoint(
        self,
        path: Any,
        map_location: Any = None,  # noqa: ARG002 - Lightning's signature
        weights_only: bool | None = None,  # noqa: ARG002
    ) -> dict[str, Any]:
        """Read a checkpoint to the CPU; the previous one if the newest is damaged.

        ``map_location`` and ``weights_only`` are Lightning's; they are ignored: a checkpoint is
        always loaded to the CPU and never runs code.

        Raises:
            InputError: If neither is there whole, or the content is more than plain data.
        """
        target = _local(path)
        chosen = target
        fault = fault_of(target)
        if fault is not None:
            chosen = previous_of(target)
            if fault_of(chosen) is not None:
                raise InputError(
                    f"{target}: checkpoint {fault}, and there is no whole one before it; "
                    "start the fit again with --overwrite"
                )
            _log.warning("%s: %s; going on from %s", target, fault, chosen.name)
        try:
            content = torch.load(chosen, map_location="cpu", weights_only=True)
        except Exception as error:
            first = str(error).partition("\n")[0]
            raise InputError(f"{chosen}: no checkpoint of plain data: {first}") from error
        if not isinstance(content, dict):
            raise InputError(f"{chosen}: holds {type(content).__name__}, expected a checkpoint")
        _refuse_nan(chosen, content.get("state_dict"))
        return content

    def remove_checkpoint(self, path: Any) -> None:
        """Remove a checkpoint and the one kept before it."""
        target = _local(path)
        storage.remove_file(target)
        storage.remove_file(previous_of(target))


SCHEMA_VERSION = 1
WEIGHTS_NAME = "model.safetensors"
DESCRIPTION_NAME = "model.json"


def save_weights(folder: Path, state: dict[str, Tensor], description: dict[str, Any]) -> None:
    """Write ``model.safetensors`` and, last, the ``model.json`` that vouches for it.

    Args:
        folder: The run.
        state: Parameters and buffers by name, on any device.
        description: Plain data; ``schema_version`` and ``sha256`` are added.
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

    Raises:
        InputError: If a file is missing or damaged.
        IncompatibleError: If a newer sononerf wrote it.
    """
    path = folder / DESCRIPTION_NAME
    require_recorded(folder, path, "fetch the run again, or repeat the fit with --overwrite")
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
