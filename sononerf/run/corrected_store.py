# SPDX-License-Identifier: MIT
"""A store without the errors of its recording that were found."""

from __future__ import annotations

import hashlib
import math
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from sononerf import locks
from sononerf.array_types import Floats
from sononerf.echoes.echoes import Echoes
from sononerf.echoes.memory_ensemble import seal
from sononerf.echoes.recorded_noise import seal_recorded
from sononerf.echoes.store import EnsembleStore
from sononerf.geometry.frame import KEYS
from sononerf.geometry.poses import Poses
from sononerf.head.attached import attach
from sononerf.head.head import Head
from sononerf.progress import Progress
from sononerf.surface.refine.self_calibration import Calibration

DECIBELS = 20.0 / math.log(10.0)
"""Decibels of a natural logarithm of magnitude."""


def write_corrected(
    echoes: Echoes, output: Path, found: Calibration, progress: Progress
) -> EnsembleStore:
    """Write echoes without the errors of their recording; an interrupted call resumes."""
    store, head = echoes.store, echoes.head
    sections = head.plain()
    speed = head.speed_of_sound * math.exp(found.speed_of_sound)
    axis = np.asarray(store.range, dtype=np.float64)
    if found.speed_of_sound:
        axis = axis * math.exp(found.speed_of_sound)
        step = axis[1] - axis[0]
        # The same slices: limits that lie between them do not depend on rounding.
        limits = {
            "range_min": float(axis[0] - step / 4.0),
            "range_max": float(axis[-1] + step / 4.0),
        }
        sections["air"] = {**sections["air"], "speed_of_sound": speed}
        sections["spectrogram"] = {**sections["spectrogram"], **limits}
    earlier = store.attributes
    kept = ("origin", "source", "licence", "format", "units", "import", *KEYS)
    with locks.lock(output):
        made = EnsembleStore.create(
            output,
            poses_positions=store.positions,
            poses_rotations=store.rotations,
            split=store.split,
            range=axis,
            frequency=store.frequency,
            attributes={
                **{name: earlier[name] for name in kept if name in earlier},
                "echo_hash": f"{earlier['echo_hash']}-{_fingerprint(found, head)}",
                "settings": sections,
                "speed_of_sound": speed,
                "calibration": {
                    **(earlier.get("calibration") or {}),
                    "self_calibration": {
                        "of": str(store.path),
                        "gain_db": (found.gain * DECIBELS).round(3).tolist(),
                        "range_offset_m": found.range_offset,
                        "speed_of_sound": speed,
                        "support": sections["support"],
                    },
                },
            },
            receivers=store.receivers,
        )
        attach(head, output)
        factor = np.exp(-found.gain)[:, None]
        with progress.task("writing", len(store)) as task:
            for index in made.missing():
                heard = moved(store.read_pose(index), np.asarray(store.range), found.range_offset)
                made.write_pose(index, (factor * heard).astype(np.float32))
                task.advance()
        poses = Poses(made.positions, made.rotations)
        silent = f"{output}: no pose heard anything"
        if earlier.get("origin") == "recorded":
            seal_recorded(made, head, poses, made.split, silent=silent)
        else:
            seal(made, {}, silent=silent)
    return EnsembleStore.open(output)


def moved(magnitude: NDArray[np.floating], axis: NDArray[np.floating], offset: float) -> Floats:
    """Return magnitudes (E, R, F) that are heard so much nearer (m), between slices linearly."""
    if offset == 0.0:
        return np.asarray(magnitude, dtype=np.float64)
    at = (axis + offset - axis[0]) / (axis[1] - axis[0])
    first = np.floor(at).astype(int)
    part = (at - first)[:, None]
    last = len(axis) - 1
    low, high = (magnitude[:, np.clip(first + more, 0, last)] for more in (0, 1))
    return np.asarray((1.0 - part) * low + part * high, dtype=np.float64)


def _fingerprint(found: Calibration, head: Head) -> str:
    plane = head.plane
    values = np.concatenate(
        [
            found.gain.ravel(),
            [found.range_offset, found.speed_of_sound],
            [] if plane is None else [*plane.point, *plane.normal],
        ]
    )
    return hashlib.sha256(np.round(values, 9).astype("<f8").tobytes()).hexdigest()[:12]
