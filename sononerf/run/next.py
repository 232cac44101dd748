# SPDX-License-Identifier: MIT
"""Proposal of the next poses of a run."""

from __future__ import annotations

from pathlib import Path

from sononerf import storage
from sononerf.errors import InputError
from sononerf.run.predict import read_poses
from sononerf.run.run import open_run
from sononerf.surface.next_poses import Within, next_poses


def propose(
    run: Path, count: int, candidates: Path | None, within: Within, output: Path | None
) -> Path:
    """Write the poses that would reduce the error of a run's surface most, the best first."""
    opened = open_run(run)
    file = output or opened.path / "next.csv"
    if file.is_dir():
        raise InputError(f"{file}: is a folder; give --output the name of a file")
    given = None if candidates is None else read_poses(opened, candidates)
    with opened.locked(file.parent):
        found = next_poses(
            opened.surface,
            opened.echoes,
            count,
            candidates=given,
            within=within,
            seed=opened.settings.fit.seed,
        )
        storage.commit_bytes(file, found.table().encode())
    return file
