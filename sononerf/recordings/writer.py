# SPDX-License-Identifier: MIT
"""Recordings as others can read them: WAV files and a table of poses."""

from __future__ import annotations

import io
from collections.abc import Sequence

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.io import wavfile

from sononerf.echoes.layout import SPLITS
from sononerf.geometry.poses import Poses, euler_from_rotation

HEADER = "file,x_m,y_m,z_m,yaw_deg,pitch_deg,roll_deg,split"


def wav_bytes(waveform: ArrayLike, sampling_rate: float) -> bytes:
    """Return a WAV file of 32-bit floats, so that levels stay as they are.

    Parameters
    ----------
    waveform : (E, S) float
        One channel per receiver.
    sampling_rate : float, Hz
        A whole number.

    Raises
    ------
    ValueError
        If the sampling rate is no whole number; a WAV file cannot hold it.
    """
    if sampling_rate != round(sampling_rate):
        raise ValueError(f"a WAV file cannot hold a sampling rate of {sampling_rate} Hz")
    buffer = io.BytesIO()
    wavfile.write(buffer, round(sampling_rate), np.asarray(waveform, dtype=np.float32).T)
    return buffer.getvalue()


def pose_table(poses: Poses, files: Sequence[str], split: NDArray[np.int8]) -> str:
    """Return the table that the format ``recordings`` reads.

    Parameters
    ----------
    poses : Poses
        P of them.
    files : sequence of str
        The recording of each.
    split : (P,) int8
        0 train, 1 validation, 2 test.
    """
    words = {number: word for word, number in SPLITS.items()}
    angles = (np.degrees(angle) for angle in euler_from_rotation(poses.rotations))
    numbers = np.column_stack([poses.positions, *angles])
    lines = [
        ",".join([name, *(repr(float(value)) for value in row), words[int(member)]])
        for name, row, member in zip(files, numbers, split, strict=True)
    ]
    return "\n".join([HEADER, *lines]) + "\n"
