# SPDX-License-Identifier: MIT
"""What an ensemble says of itself: plain data with a checksum, in the group's own file."""

from __future__ import annotations

import hashlib
import json
from pathlib import Path
from typing import Any

from sononerf import storage
from sononerf.errors import IncompatibleError, InputError, NumericalError

FORMAT = "sononerf-ensemble"
SCHEMA_VERSION = 1
_RESERVED = ("checksum", "format", "schema_version")


def plain_attributes(path: Path, attributes: dict[str, Any]) -> dict[str, Any]:
    """Return attributes as JSON would give them back, sorted, so that bytes know no order.

    Raises
    ------
    NumericalError
        If a value is NaN or infinite.
    """
    plain = {key: value for key, value in attributes.items() if key not in _RESERVED}
    try:
        result: dict[str, Any] = json.loads(storage.to_json(plain, sort_keys=True))
    except ValueError as error:
        raise NumericalError(f"{path}: an attribute is NaN or infinite") from error
    return result


def _checksum(plain: dict[str, Any]) -> str:
    return hashlib.sha256(storage.to_json(plain, sort_keys=True).encode()).hexdigest()


def write_group(path: Path, plain: dict[str, Any]) -> None:
    """Write the group's own file; zarr's update would keep the order of the calls in its bytes."""
    own = {"format": FORMAT, "schema_version": SCHEMA_VERSION, "checksum": _checksum(plain)}
    group = {"zarr_format": 3, "node_type": "group", "attributes": {**own, **plain}}
    storage.commit_json(path / "zarr.json", group)


def read_attributes(path: Path) -> dict[str, Any]:
    """Return a store's attributes, checked, without the format's own names.

    Raises
    ------
    InputError
        If it is none of our ensembles, or its attributes are damaged.
    IncompatibleError
        If another version of the format wrote it.
    """
    group = storage.read_json(path / "zarr.json")
    try:
        is_group = (group["node_type"], group["zarr_format"]) == ("group", 3)
        stored = dict(group["attributes"])
    except (KeyError, TypeError, ValueError):
        is_group, stored = False, {}
    if not is_group or stored.get("format") != FORMAT:
        raise InputError(f"{path}: no ensemble of sononerf, or its zarr.json is damaged")
    version = stored.get("schema_version")
    if version != SCHEMA_VERSION:
        raise IncompatibleError(
            f"{path}: schema_version {version!r}, this sononerf reads {SCHEMA_VERSION}; "
            "install the sononerf that wrote it"
        )
    plain = {key: value for key, value in stored.items() if key not in _RESERVED}
    if _checksum(plain) != stored.get("checksum"):
        raise InputError(f"{path}: attributes damaged (checksum); simulate or fetch it again")
    return plain
