# SPDX-License-Identifier: MIT
"""Echoes: a store, its head, and what is found in them once; echoes minus those of a background."""

from __future__ import annotations

from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from sononerf.array_types import Ints, Singles
from sononerf.echoes.detection import Onsets, find_onsets
from sononerf.echoes.free_space import EchoHull, weighted
from sononerf.echoes.layout import AXES
from sononerf.echoes.region import WITNESS_GAIN, EchoRegion
from sononerf.echoes.store import EnsembleStore
from sononerf.errors import IncompatibleError, InputError, NumericalError
from sononerf.head.head import Head

if TYPE_CHECKING:  # simulation starts without it
    from torch import Tensor

KEPT_BYTES = 400_000_000
"""Size of the spectrograms that stay in memory, bytes; further ones are read at each use."""
HELD_BACK = 10
"""Without validation poses, one of this many training poses validates the refinement."""


class Echoes:
    """The spectrograms of one store, and the head that heard them.

    Args:
        store: Poses, splits, axes and spectrograms.
        head: What heard them.
        hull: The free space, where it is known already; found from the onsets where None.

    Attributes:
        positions ((P, 3), m): Of the head, world frame.
        rotations (P, 3, 3): Head to world.
        training, validation (...,): Poses that a surface is refined on and compared on. Where the
            store has no validation poses, some of its training poses validate.
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
            import torch

            heard = torch.as_tensor(self.store.read_pose(number))
            size = heard.numel() * heard.element_size()
            if self._bytes + size > KEPT_BYTES:
                return heard
            self._kept[number] = heard
            self._bytes += size
        return self._kept[number]

    def batch(self, seed: int, step: int, size: int) -> Ints:
        """Return the training poses of a step: all in turn, in an order drawn from the seed."""
        count = len(self.training)
        size = min(size, count)
        wanted = []
        for place in range(step * size, (step + 1) * size):
            order = np.random.default_rng([seed, place // count]).permutation(count)
            wanted.append(self.training[order[place % count]])
        return np.array(wanted, dtype=np.int64)


class SubtractedStore(EnsembleStore):
    """Reads an ensemble, and takes the power of another one at the same poses off it.

    Phase is not heard, so what both have in one cell is taken off as power; what sounded there with
    more power alone than together leaves silence.

    Args:
        path: What was heard of target and surroundings.
        background: What was heard of the surroundings alone.

    Raises:
        InputError: If there is no such store, one is damaged, or a pose is missing.
        IncompatibleError: If poses, ranges or frequencies differ.
    """

    def __init__(self, path: Path, background: Path) -> None:
        super().__init__(path)
        self._background = EnsembleStore.open(background)
        for name in AXES:
            mine, theirs = self._axes[name], self._background._axes[name]
            if mine.shape != theirs.shape or not np.allclose(mine, theirs, rtol=0, atol=1e-6):
                raise IncompatibleError(
                    f"{background}: its {name} differs from that of {path}; a background is heard "
                    "at the same poses and analysed alike"
                )
        missing = self._background.missing()
        if missing:
            raise InputError(
                f"{background}: pose {missing[0]} is missing; finish it with `sononerf simulate`"
            )

    def __reduce__(self) -> tuple[Any, ...]:
        return SubtractedStore, (self.path, self._background.path)

    def read_pose(self, index: int) -> Singles:
        """Return one pose's magnitude, (E, R, F), less the surroundings."""
        whole = np.square(super().read_pose(index), dtype=np.float64)
        left = whole - np.square(self._background.read_pose(index), dtype=np.float64)
        return np.sqrt(left.clip(min=0.0)).astype(np.float32)

    @property
    def attributes(self) -> dict[str, Any]:
        """As of the whole, but for the loudness of what is left; its noise floor is not known."""
        unknown = dict.fromkeys(("noise_floor_mae_db", "noise_floor_mae_db_active"))
        given = super().attributes
        return {**given, **unknown, "reference": given["reference"] * self._part}

    @cached_property
    def _part(self) -> float:
        """How loud the loudest training cell is beside that of the whole."""
        train = [int(index) for index in self.indices("train")]
        left = max(float(self.read_pose(index).max()) for index in train)
        if not left > 0.0:
            raise NumericalError(
                f"{self._background.path}: as loud as {self.path} everywhere, so nothing is left; "
                "is it the same ensemble?"
            )
        return left / max(float(super(SubtractedStore, self).read_pose(i).max()) for i in train)
