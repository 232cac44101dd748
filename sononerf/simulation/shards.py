# SPDX-License-Identifier: MIT
"""Shards: stores beside that of an ensemble, each with some of its poses, for batch systems."""

from __future__ import annotations

import glob
from dataclasses import dataclass
from pathlib import Path

from sononerf.echoes.store import EnsembleStore
from sononerf.errors import IncompatibleError, SettingsError

SHARD = ".shard-"
"""Part between the name of an ensemble's store and the number of a shard."""


@dataclass(frozen=True)
class Shard:
    """Some poses of an ensemble: every ``count``-th, from the ``number``-th on.

    Attributes:
        number: From 1 on.
        count: Number of all.
    """

    number: int
    count: int

    def __post_init__(self) -> None:
        if not 1 <= self.number <= self.count:
            raise SettingsError(
                f"--shard: found {self.number}/{self.count}; give I/N with I from 1 to N"
            )

    @classmethod
    def of(cls, text: str) -> Shard:
        """Return the shard of a text ``I/N``."""
        number, _, count = text.partition("/")
        if not (number.isdecimal() and count.isdecimal()):
            raise SettingsError(f"--shard: found {text!r}; give I/N, such as 3/16")
        return cls(int(number), int(count))

    def path(self, whole: Path) -> Path:
        """Return the shard's store beside that of the whole ensemble."""
        return whole.with_name(f"{whole.name}{SHARD}{self.number}-of-{self.count}")


def take_shards(store: EnsembleStore, path: Path) -> None:
    """Take what is missing of an ensemble from its shards.

    Args:
        store: Store of the whole ensemble, opened for writing.
        path: Its folder; those of the shards are beside it.

    Raises:
        InputError: If a shard is damaged.
        IncompatibleError: If a shard is of other settings, or was traced with other rays.
    """
    for folder in sorted(path.parent.glob(f"{glob.escape(path.name)}{SHARD}*")):
        shard = EnsembleStore.open(folder)
        there = set(range(len(shard))) - set(shard.missing())
        if not there:  # it was stopped before its first pose
            continue
        rays = shard.attributes.get("rays")
        for key, known in (
            ("echo_hash", store.attributes.get("echo_hash")),
            ("rays", store.attributes.get("rays", rays)),
        ):
            if shard.attributes.get(key) != known:
                raise IncompatibleError(
                    f"{folder}: is a shard of other echoes ({key} differs); remove it, or simulate "
                    "it anew"
                )
        store.update_attributes(rays=rays)
        for index in sorted(there & set(store.missing())):
            store.write_pose(index, shard.read_pose(index))
