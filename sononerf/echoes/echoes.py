# SPDX-License-Identifier: MIT
"""What a head heard at its poses, with the onsets and the free space, found when first needed."""

from __future__ import annotations

from functools import cached_property

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from sononerf.echoes.consistency import weighted
from sononerf.echoes.free_space import EchoHull
from sononerf.echoes.onsets import Onsets, find_onsets
from sononerf.echoes.region import WITNESS_GAIN, EchoRegion
from sononerf.echoes.store import EnsembleStore
from sononerf.head.head import Head

KEPT_BYTES = 400_000_000
"""Size of the spectrograms that stay in memory, bytes; further ones are read at each use."""
HELD_BACK = 10
"""Without validation poses, one of this many training poses validates the refinement."""


class Echoes:
    """The spectrograms of one store, and the head that heard them.

    Parameters
    ----------
    store : EnsembleStore
        Poses, splits, axes and spectrograms.
    head : Head
        What heard them.
    hull : EchoHull or None
        The free space, where it is known already; found from the onsets where None.

    Attributes
    ----------
    positions : (P, 3) float64, m
        Of the head, world frame.
    rotations : (P, 3, 3) float64
        Head to world.
    training, validation : (...,) int64
        Poses that a surface is refined on and compared on. Where the store has no validation poses,
        some of its training poses validate.
    """

    def __init__(self, store: EnsembleStore, head: Head, hull: EchoHull | None = None) -> None:
        self.store, self.head = store, head
        self.positions, self.rotations = store.positions, store.rotations
        training, validation = store.indices("train"), store.indices("val")
        if not len(validation) and len(training) > 1:
            held = np.arange(len(training)) % HELD_BACK == HELD_BACK // 2
            held[len(training) // 2] = True
            training, validation = training[~held], training[held]
        self.training, self.validation = training, validation
        self._kept: dict[int, Tensor] = {}
        self._bytes = 0
        if hull is not None:
            self.hull = hull

    @property
    def reference(self) -> float:
        """Magnitude m0 that reported decibels refer to."""
        return float(self.store.attributes["reference"])

    @property
    def calibrated(self) -> bool:
        """Whether the level is absolute. That of a recording depends on its amplifier."""
        return bool(self.store.attributes.get("origin") == "simulated")

    @cached_property
    def onsets(self) -> Onsets:
        """Echoes that are detected at the training poses."""
        return find_onsets(self.store, self.head.point_echo)

    @cached_property
    def hull(self) -> EchoHull:
        """Space that the onsets leave; outliers have weight zero."""
        onsets, head = self.onsets, self.head
        rotations = self.rotations[onsets.poses]
        emitters, receivers = head.places(self.positions[onsets.poses], rotations)
        hull = EchoHull(
            emitters=emitters,
            receivers=receivers,
            first=onsets.first - head.mean_lag,
            axes=rotations[:, :, 0],
            within=head.row_gains.cone(WITNESS_GAIN),
        )
        return weighted(hull, head.resolution)

    @cached_property
    def region(self) -> EchoRegion:
        """Places that the echoes leave possible."""
        turned = self.rotations[self.onsets.poses]
        return EchoRegion(self.onsets, self.hull, self.head.gains, turned, self.head.resolution)

    def magnitude(self, number: int) -> Tensor:
        """Return what a pose heard, (E, R, F) float32 linear magnitude, on the CPU."""
        if number not in self._kept:
            heard = torch.as_tensor(self.store.read_pose(number))
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
