# SPDX-License-Identifier: MIT
"""Figures of one version on one machine, kept to be compared with those of another."""

from __future__ import annotations

import json
import platform
import re
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import torch

from sononerf import __version__, storage
from tools.benchmarks.experiment import aligned, origin

LIST_KEY = "name"
"""By which the rows of two files are put beside each other."""


def device_name(accelerator: str) -> str:
    """Return what torch calls the device that an accelerator stands for: ``cpu`` or ``cuda``."""
    return "cuda" if accelerator != "cpu" and torch.cuda.is_available() else "cpu"


def keep(output: Path, what: str, device: str, found: dict[str, Any]) -> Path:
    """Write figures to ``WHAT-VERSION-MACHINE-DEVICE.json``.

    Returns
    -------
    path : Path
        Of the file.
    """
    chip = torch.cuda.get_device_name() if device == "cuda" else device
    parts = (what, __version__, platform.node() or platform.machine(), chip)
    name = "-".join(re.sub(r"[^A-Za-z0-9.]+", "_", part) for part in parts)
    path = output / f"{name}.json"
    storage.make_folder(output)
    storage.commit_json(path, {**origin(), "device": chip, **found})
    return path


def ratios(old: Path, found: dict[str, Any]) -> str:
    """Return what each number is over that of an older file, by its dotted name."""
    before = dict(_numbers(storage.read_json(old)))
    lines = [["figure", "before", "now", "ratio"]]
    for name, now in _numbers(json.loads(json.dumps(found))):
        then = before.get(name)
        if then:
            lines.append([name, f"{then:.4g}", f"{now:.4g}", f"{now / then:.2f}"])
    return "\n".join(aligned(lines))


def _numbers(data: Any, name: str = "") -> Iterator[tuple[str, float]]:
    """Yield numbers with their dotted names; of rows, by what they are called."""
    if isinstance(data, bool):
        return
    if isinstance(data, int | float):
        yield name, float(data)
    elif isinstance(data, dict):
        for key, value in data.items():
            yield from _numbers(value, f"{name}.{key}" if name else key)
    elif isinstance(data, list):
        for item in data:
            if isinstance(item, dict) and LIST_KEY in item:
                yield from _numbers(item, f"{name}.{item[LIST_KEY]}")
