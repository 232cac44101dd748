# SPDX-License-Identifier: MIT
r"""The noise of recordings, from the sound before the first echoes.

Noise of many sources has a magnitude of Rayleigh's distribution: the median of its power is
:math:`\sigma^2 \ln 2`, and its magnitude exceeds :math:`\sigma \sqrt{\ln(1 / p)}` with probability
p.
"""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from sononerf.array_types import Floats, Ints, Singles
from sononerf.echoes.detection import find_onsets
from sononerf.echoes.memory_ensemble import Ensemble, seal
from sononerf.echoes.splits import repeats
from sononerf.geometry.poses import Poses
from sononerf.head.decibels import EXCEEDED
from sononerf.head.head import Head

BEFORE = 2.0
"""Least distance, range resolutions, between the first echo and the slices in front of it that give
the noise: the echo's rising flank and nearest sidelobes lie closer."""
CELLS = 100
"""Least number of slices, over all poses, that give the noise of a receiver."""


def noise_rms(store: Ensemble, head: Head) -> Floats | None:
    """Return the root mean square of the noise, (E, F) linear magnitude."""
    onsets = find_onsets(store, head.point_echo)
    quiet = (
        store.range[None, None] < onsets.first[..., None] - BEFORE * head.resolution
    )  # (P, E, R)
    if (quiet.sum(axis=(0, 2)) < CELLS).any():
        return None
    heard: list[list[Singles]] = [[] for _ in range(store.receivers)]
    for row, pose in enumerate(onsets.poses.tolist()):
        magnitude = store.read_pose(pose)
        for ear, kept in enumerate(heard):
            kept.append(magnitude[ear][quiet[row, ear]])
    power = np.stack([np.median(np.square(np.concatenate(kept)), axis=0) for kept in heard])
    return np.asarray(np.sqrt(power.astype(np.float64) / math.log(2.0)))


def heard_again(magnitude: NDArray[np.floating], noise: Floats, seed: int) -> Singles:
    """Return another draw of the same pose's spectrogram, (E, R, F).

    Cells above the noise get the difference of two draws of noise. Cells below are noise, and are
    drawn again.

    In: magnitude (E, R, F), noise (E, F).
    """
    rng = np.random.default_rng(seed)
    parts = rng.standard_normal((2, *magnitude.shape)) * (noise[:, None] / math.sqrt(2.0))
    drawn = parts[0] + 1j * parts[1]
    least = noise[:, None] * math.sqrt(math.log(1.0 / EXCEEDED))
    again = np.where(magnitude > least, np.abs(magnitude + math.sqrt(2.0) * drawn), np.abs(drawn))
    return again.astype(np.float32)


def seal_recorded(
    store: Ensemble, head: Head, poses: Poses, split: NDArray[np.int8], *, silent: str
) -> None:
    """Seal recorded echoes with their noise, and the noise floor of the test poses.

    The floor comes from poses that were recorded twice, or else from the noise before the first
    echoes.

    In: split (P,).
    """
    pairs = repeats(poses, split)
    again = {index: store.read_pose(other) for index, other in pairs.items()}
    test: Ints = store.indices("test")
    source, noise = ("repeated poses" if again else None), None
    if any(store.read_pose(int(index)).any() for index in store.indices("train")):
        noise = noise_rms(store, head)
    if noise is not None and noise.any() and not again and len(test):
        source = "noise before the first echoes"
        for index in test.tolist():
            again[index] = heard_again(store.read_pose(index), noise, index)
    store.update_attributes(noise_floor_of=source)
    seal(store, again, silent=silent, noise=noise)
