# SPDX-License-Identifier: MIT
"""Lightning's checkpoints through the one write path, checked before they are believed.

Lightning's own save is neither atomic across file systems nor durable, and ``torch.load`` does
not look at the checksums that a checkpoint, a zip archive, carries.
"""

from __future__ import annotations

import logging
import zipfile
from pathlib import Path
from typing import Any, BinaryIO

import torch
from lightning.pytorch.plugins.io import CheckpointIO

from sononerf import storage
from sononerf.errors import InputError

_log = logging.getLogger("sononerf")


def _local(path: Any) -> Path:
    text = str(path)
    if "://" in text or "::" in text:
        raise InputError(f"{text}: a checkpoint is a local file; URLs are not opened")
    return Path(text)


def previous_of(path: Path) -> Path:
    """Return the name under which the checkpoint before the newest is kept."""
    return path.with_name(path.name + ".previous")


def fault_of(path: Path) -> str | None:
    """Return what is wrong with a checkpoint's archive, or None where its checksums hold."""
    try:
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

        Raises
        ------
        StorageError
            If it cannot be written; the old one is then untouched.
        InputError
            If the path is a URL.
        """
        target = _local(path)

        def write(file: BinaryIO) -> None:
            try:
                torch.save(checkpoint, file)
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
        """Read a checkpoint to the CPU; the one before where the newest is damaged.

        ``map_location`` and ``weights_only`` are Lightning's; a checkpoint is always loaded to
        the CPU and never runs code, whatever they say.

        Raises
        ------
        InputError
            If neither is there whole, or the content is more than plain data.
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
        return content

    def remove_checkpoint(self, path: Any) -> None:
        """Remove a checkpoint and the one kept before it."""
        target = _local(path)
        storage.remove_file(target)
        storage.remove_file(previous_of(target))
