# SPDX-License-Identifier: MIT
"""Which poses of an ensemble are done: a journal while it grows, one sorted file when whole."""

from __future__ import annotations

import hashlib
import json
import zlib
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from sononerf import storage
from sononerf.errors import IncompatibleError, InputError

SCHEMA_VERSION = 1


@dataclass(frozen=True)
class PoseRecord:
    """What proves that a pose is there whole: its file's size and its content's SHA-256."""

    size: int
    sha256: str

    def plain(self) -> dict[str, Any]:
        """Return the record as plain data."""
        return {"sha256": self.sha256, "size": self.size}


def _record(data: dict[str, Any]) -> PoseRecord:
    return PoseRecord(int(data["size"]), str(data["sha256"]))


class Manifest:
    """The record of finished poses, ``manifest.json`` overlaid by ``manifest.jsonl``.

    Args:
        folder: The ensemble's folder.
    """

    def __init__(self, folder: Path) -> None:
        self.path = folder / "manifest.json"
        self.journal = folder / "manifest.jsonl"

    def add(self, pose: int, record: PoseRecord) -> None:
        """Append a finished pose to the journal, durably."""
        body = storage.to_json({"pose": pose, **record.plain()}, sort_keys=True)
        # The checksum covers the text before it, so that a torn or damaged line is no record.
        storage.append_line(self.journal, f"{body[:-1]},{_checksum_field(body)}}}")

    def read(self) -> dict[int, PoseRecord]:
        """Return the finished poses in order."""
        records = self._read_sealed() if self.path.exists() else {}
        records.update(self._read_journal())
        return dict(sorted(records.items()))

    def _read_sealed(self) -> dict[int, PoseRecord]:
        data = storage.read_json(self.path)
        try:
            version = data["schema_version"]
            if version != SCHEMA_VERSION:
                raise IncompatibleError(
                    f"{self.path}: schema_version {version!r}, this sononerf reads "
                    f"{SCHEMA_VERSION}; install the sononerf that wrote it"
                )
            records = {int(pose): _record(entry) for pose, entry in data["poses"].items()}
            if data["checksum"] == _digest(records):
                return records
        except (KeyError, TypeError, ValueError, AttributeError):
            pass
        raise InputError(
            f"{self.path}: damaged; remove it and simulate again, or fetch the ensemble again"
        )

    def _read_journal(self) -> dict[int, PoseRecord]:
        try:
            lines = self.journal.read_bytes().split(b"\n")
        except FileNotFoundError:
            return {}
        except OSError as error:
            raise InputError(f"{self.journal}: cannot be read ({error.strerror})") from None
        records = {}
        for line in lines:
            with suppress(ValueError, KeyError, TypeError, RecursionError):
                data = json.loads(line.decode())
                pose, record = int(data["pose"]), _record(data)
                body = storage.to_json({"pose": pose, **record.plain()}, sort_keys=True)
                if line.decode() == f"{body[:-1]},{_checksum_field(body)}}}":
                    records[pose] = record
        return records

    def seal(self) -> None:
        """Compact the journal into ``manifest.json``, whose bytes know no order of writing."""
        records = self.read()
        poses = {str(pose): record.plain() for pose, record in records.items()}
        data = {"schema_version": SCHEMA_VERSION, "checksum": _digest(records), "poses": poses}
        storage.commit_json(self.path, data)
        storage.remove_file(self.journal)


def _checksum_field(body: str) -> str:
    return f'"crc32":{zlib.crc32(body.encode())}'


def _digest(records: dict[int, PoseRecord]) -> str:
    plain = {str(pose): record.plain() for pose, record in sorted(records.items())}
    return hashlib.sha256(storage.to_json(plain, sort_keys=True).encode()).hexdigest()
