# SPDX-License-Identifier: MIT
"""What was measured, as the refinement needs it: heads and spectrograms, read when asked for."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from sononerf.echoes.store import EnsembleStore

KEPT_BYTES = 400_000_000
"""Spectrograms that stay in memory."""
HELD_BACK = 10
"""Every so many training poses one is held back for validation, where an ensemble has none."""


@dataclass(eq=False)
class Echoes:
    """An ensemble's poses and what they heard.

    Attributes
    ----------
    positions : (P, 3) float64, m
        Of the heads.
    rotations : (P, 3, 3) float64
        Head to world.
    training, validation : (...,) int64
        Numbers of the poses.
    read : callable
        From a pose's number to its magnitude (E, R, F).
    """

    positions: NDArray[np.float64]
    rotations: NDArray[np.float64]
    training: NDArray[np.int64]
    validation: NDArray[np.int64]
    read: Callable[[int], NDArray[np.float32]]
    _kept: dict[int, Tensor] = field(default_factory=dict, repr=False)
    _bytes: int = field(default=0, repr=False)

    @classmethod
    def of(cls, store: EnsembleStore) -> Echoes:
        """Return those of a store; where it has no validation poses, some training poses serve."""
        training, validation = store.indices("train"), store.indices("val")
        if not len(validation) and len(training) > 1:
            held = np.arange(len(training)) % HELD_BACK == HELD_BACK // 2
            held[len(training) // 2] = True
            training, validation = training[~held], training[held]
        return cls(store.positions, store.rotations, training, validation, store.read_pose)

    def magnitude(self, number: int) -> Tensor:
        """Return what a pose heard, (E, R, F) float32, on the CPU."""
        if number not in self._kept:
            heard = torch.as_tensor(self.read(number))
            size = heard.numel() * heard.element_size()
            if self._bytes + size > KEPT_BYTES:
                return heard
            self._kept[number] = heard
            self._bytes += size
        return self._kept[number]

    def batch(self, seed: int, step: int, size: int) -> NDArray[np.int64]:
        """Return the training poses of a step: all in turn, in an order drawn from the seed."""
        count = len(self.training)
        size = min(size, count)
        wanted = []
        for place in range(step * size, (step + 1) * size):
            order = np.random.default_rng([seed, place // count]).permutation(count)
            wanted.append(self.training[order[place % count]])
        return np.array(wanted, dtype=np.int64)


def on_rows(wholes: list[Tensor], row: Tensor, like: Tensor) -> Tensor:
    """Return the range slices of whole spectrograms from given rows on.

    Parameters
    ----------
    wholes : list of (E, R, F) float32
        One per pose.
    row : (P,) int64
        Each pose's first row; may lie before the axis.
    like : (P, E, W, F) Tensor
        Whose width and device the result has.

    Returns
    -------
    parts : (P, E, W, F) float32
        Zero beyond the axis.
    """
    width = like.shape[2]
    parts = []
    for whole, start in zip(wholes, row.tolist(), strict=True):
        first, last = max(start, 0), min(start + width, whole.shape[1])
        part = torch.zeros(whole.shape[0], width, whole.shape[2])
        if last > first:
            part[:, first - start : last - start] = whole[:, first:last]
        parts.append(part)
    return torch.stack(parts).to(like.device)
