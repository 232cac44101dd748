# SPDX-License-Identifier: MIT
"""Which surface of a run its validation poses bore out, as its traces remember it."""

from __future__ import annotations

from pathlib import Path
from typing import Literal

from safetensors import SafetensorError, safe_open

from sononerf import storage
from sononerf.weights import DESCRIPTION_NAME

NAME = "retrace.safetensors"
Surface = Literal["auto", "hull"]
"""The read-out's own choice, or what the first echoes leave."""


def model_of(path: Path) -> str:
    """Return the checksum of the field that a run's folder holds."""
    return str(storage.read_json(path / DESCRIPTION_NAME)["sha256"])


def borne_out(path: Path) -> Surface:
    """Return how a run's surface is best found; ``auto`` where that was not found out."""
    try:
        with safe_open(str(path / NAME), "pt") as opened:
            known = (opened.metadata() or {}).get("model")
            hull = bool(opened.get_tensor("hull"))
    except (SafetensorError, OSError, RuntimeError):
        return "auto"
    return "hull" if hull and known == model_of(path) else "auto"
