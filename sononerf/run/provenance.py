# SPDX-License-Identifier: MIT
"""What a run states about itself: settings that may change, sources, versions, machine."""

from __future__ import annotations

import importlib.metadata
import os
import platform
from collections.abc import Mapping
from typing import Any

from sononerf.geometry.frame import KEYS
from sononerf.settings.schema import Settings
from sononerf.version import __version__

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
    found: dict[str, Any] = {}
    for key, value in data.items():
        name = f"{prefix}{key}"
        if isinstance(value, dict) and value:
            found.update(flat(value, f"{name}."))
        else:
            found[name] = value
    return found


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
