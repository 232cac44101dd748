# SPDX-License-Identifier: MIT
"""One recording, and recordings as files: WAV and a table of poses."""

from __future__ import annotations

import io
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.io import wavfile

from sononerf.echoes.layout import SPLITS
from sononerf.geometry.poses import Poses, euler_from_rotation
from sononerf.recordings.columns import Columns

HEADER = "file,x_m,y_m,z_m,yaw_deg,pitch_deg,roll_deg,split"


def wav_bytes(waveform: ArrayLike, sampling_rate: float) -> bytes:
    """Return a WAV file of 32-bit floats, so that levels stay as they are.

    Args:
        waveform (E, S): One channel per receiver.
        sampling_rate (Hz): A whole number.

    Raises:
        ValueError: If the sampling rate is no whole number; a WAV file cannot hold it.
    """
    if sampling_rate != round(sampling_rate):
        raise ValueError(f"a WAV file cannot hold a sampling rate of {sampling_rate} Hz")
    buffer = io.BytesIO()
    wavfile.write(buffer, round(sampling_rate), np.asarray(waveform, dtype=np.float32).T)
    return buffer.getvalue()


def pose_table(poses: Poses, files: Sequence[str], split: NDArray[np.int8]) -> str:
    """Return the table that the format ``recordings`` reads.

    Args:
        poses: P of them.
        files: The recording of each.
        split ((P,) int8): 0 train, 1 validation, 2 test.
    """
    words = {number: word for word, number in SPLITS.items()}
    angles = (np.degrees(angle) for angle in euler_from_rotation(poses.rotations))
    numbers = np.column_stack([poses.positions, *angles])
    lines = [
        ",".join([name, *(repr(float(value)) for value in row), words[int(member)]])
        for name, row, member in zip(files, numbers, split, strict=True)
    ]
    return "\n".join([HEADER, *lines]) + "\n"


@dataclass(frozen=True, eq=False)
class Recording:
    """Pings as they were recorded, and the table that says where each of them was.

    Attributes:
        path: Where it was read from, for messages.
        sampling_rate: Hz.
        labels: What each of the P pings is called in messages.
        emission ((P,), s): When the call of each ping left, counted from the first sample that
            :attr:`read` gives. Negative where the recording began later.
        read: Takes the number of a ping and returns its samples (E, S) as they are on disk:
            integers reach from one end of their type to the other, floats have the user's unit.
        columns: Poses as in the table, in its own frame.
        settings: What the source itself says of ``air``, ``ears`` and ``call``: plain data by
            section.
        notes: What was understood and may surprise, one line each.
    """

    path: Path
    sampling_rate: float
    labels: tuple[str, ...]
    emission: NDArray[np.float64]
    read: Callable[[int], NDArray[Any]]
    columns: Columns
    settings: dict[str, dict[str, Any]] = field(default_factory=dict)
    notes: tuple[str, ...] = ()

    def __len__(self) -> int:
        return len(self.labels)
