# SPDX-License-Identifier: MIT
"""Batches of range slices, each a function of seed and number alone, and whole poses."""

from __future__ import annotations

from collections import OrderedDict
from typing import Literal, NamedTuple

import numpy as np
import torch
from torch import Tensor
from torch.utils.data import DataLoader, Dataset

from sononerf.echoes.memory_ensemble import Ensemble
from sononerf.errors import SettingsError


class RangeSlices(NamedTuple):
    """A batch of slices, the same number from each of its poses."""

    pose: Tensor  # (P,) int, as numbered in the store
    position: Tensor  # (P, 3) m
    rotation: Tensor  # (P, 3, 3) head to world
    rows: Tensor  # (P, R) int, which range slices
    bins: Tensor  # (B,) int, which frequencies
    spectrum: Tensor  # (P, E, R, B) linear magnitude; no ears where nothing was measured


def _silent(spectrogram: Tensor, below: float) -> Tensor:
    """Return which slices of one pose (E, R, F) no ear hears anything in, (R,) bool."""
    return spectrogram.amax(dim=(0, 2)) < below


def seed_of(*parts: int) -> int:
    """Mix whole numbers into one seed for torch."""
    return int(np.random.SeedSequence(parts).generate_state(1, np.uint64)[0] >> np.uint64(1))


class PoseReader:
    """Spectrograms of a store, kept in memory up to a bound, the oldest given up first."""

    def __init__(self, store: Ensemble, memory_bytes: int) -> None:
        self.store = store
        each = store.receivers * len(store.range) * len(store.frequency) * 4
        self.most = max(1, memory_bytes // each)
        self._kept: OrderedDict[int, Tensor] = OrderedDict()

    def __getitem__(self, index: int) -> Tensor:
        """Return one pose's magnitude, (E, R, F); in memory one frequency after the other."""
        if index in self._kept:
            self._kept.move_to_end(index)
            return self._kept[index]
        read = torch.from_numpy(self.store.read_pose(index))
        spectrogram = read.movedim(-1, 0).contiguous().movedim(0, -1)
        self._kept[index] = spectrogram
        if len(self._kept) > self.most:
            self._kept.popitem(last=False)
        return spectrogram


class SliceStream(Dataset[RangeSlices]):
    """The training batches; item k is batch k, in any process and in any order.

    In: share (int, int).
    """

    def __init__(
        self,
        store: Ensemble,
        split: Literal["train", "val", "test"],
        *,
        whole_poses: bool,
        batch: int,
        batch_frequencies: int | None,
        seed: int,
        memory_bytes: int,
        share: tuple[int, int] = (0, 1),
        silent_share: float = 1.0,
        silent_below: float = 0.0,
    ) -> None:
        self.reader = PoseReader(store, memory_bytes)
        self.poses = torch.as_tensor(store.indices(split))
        self.positions = torch.as_tensor(store.positions, dtype=torch.float32)
        self.rotations = torch.as_tensor(store.rotations, dtype=torch.float32)
        self.ranges = len(store.range)
        self.frequencies = len(store.frequency)
        self.axis = store.range
        self.whole_poses = whole_poses
        self.met: Tensor | None = None  # which slices, where not all
        if silent_share < 1.0:
            if whole_poses:
                raise ValueError("whole poses are met with their silence")
            self.met = self._met(silent_share, silent_below, seed)
        every = len(self.poses) if whole_poses else len(self.poses) * self.ranges
        self.items = every if self.met is None else len(self.met)
        self.batch = min(batch, self.items)
        if self.batch < share[1]:
            raise SettingsError(
                f"a batch of {self.batch} cannot be shared by {share[1]} devices; raise "
                "fit.batch_poses or fit.batch_slices, or use fewer devices"
            )
        self.batch_frequencies = min(batch_frequencies or self.frequencies, self.frequencies)
        self.seed = seed
        self.share = share
        self._order: tuple[int, Tensor] = (-1, torch.zeros(0, dtype=torch.long))

    @property
    def batches_per_pass(self) -> int:
        """Steps in which every pose or slice is met once."""
        return -(-self.items // self.batch)

    def _met(self, silent_share: float, silent_below: float, seed: int) -> Tensor:
        """Return the slices that sound and some of those that do not, ascending."""
        poses = self.poses.tolist()
        silent = torch.cat([_silent(self.reader[pose], silent_below) for pose in poses])
        sounding, rest = (mask.nonzero()[:, 0] for mask in (~silent, silent))
        generator = torch.Generator().manual_seed(seed_of(seed, 3))
        drawn = torch.randperm(len(rest), generator=generator)[: round(silent_share * len(rest))]
        return torch.cat((sounding, rest[drawn])).sort().values

    def _items_of(self, step: int) -> Tensor:
        turn, part = divmod(step, self.batches_per_pass)
        if self._order[0] != turn:
            generator = torch.Generator().manual_seed(seed_of(self.seed, 1, turn))
            self._order = (turn, torch.randperm(self.items, generator=generator))
        # The last batch of a pass is filled up from its beginning, so all have one size.
        index = torch.arange(part * self.batch, (part + 1) * self.batch) % self.items
        items = self._order[1][index][self.share[0] :: self.share[1]]
        return items if self.met is None else self.met[items]

    def __getitem__(self, step: int) -> RangeSlices:
        """Return batch ``step``."""
        items = self._items_of(step)
        if self.batch_frequencies < self.frequencies:
            generator = torch.Generator().manual_seed(seed_of(self.seed, 2, step))
            bins = torch.randperm(self.frequencies, generator=generator)
            bins = bins[: self.batch_frequencies].sort().values
        else:
            bins = torch.arange(self.frequencies)
        if self.whole_poses:
            pose = self.poses[items]
            rows = torch.arange(self.ranges).expand(len(pose), -1)
            by_frequency = [self.reader[int(p)].movedim(-1, 0).index_select(0, bins) for p in pose]
            spectrum = torch.stack(by_frequency).movedim(1, -1)
        else:
            pose = self.poses[items // self.ranges]
            rows = (items % self.ranges)[:, None]
            spectrum = torch.stack(
                [
                    self.reader[int(p)][:, r][..., bins]
                    for p, r in zip(pose.tolist(), rows, strict=True)
                ]
            )
        return RangeSlices(pose, self.positions[pose], self.rotations[pose], rows, bins, spectrum)


class WholePoses(Dataset[RangeSlices]):
    """Poses one by one with all ranges and frequencies, for validation, tests and prediction.

    In: positions ((P, 3), m), rotations (P, 3, 3), numbers ((P,) int or None).
    """

    def __init__(
        self,
        positions: Tensor,
        rotations: Tensor,
        ranges: int,
        frequencies: int,
        reader: PoseReader | None = None,
        numbers: Tensor | None = None,
    ) -> None:
        self.positions = positions.float()
        self.rotations = rotations.float()
        self.rows = torch.arange(ranges)[None]
        self.bins = torch.arange(frequencies)
        self.reader = reader
        self.numbers = torch.arange(len(positions)) if numbers is None else numbers

    def __len__(self) -> int:
        return len(self.positions)

    def __getitem__(self, index: int) -> RangeSlices:
        """Return one pose as a batch of one."""
        measured = torch.zeros(1, 0, self.rows.shape[1], len(self.bins))
        if self.reader is not None:
            measured = self.reader[int(self.numbers[index])][None]
        return RangeSlices(
            self.numbers[index : index + 1],
            self.positions[index : index + 1],
            self.rotations[index : index + 1],
            self.rows,
            self.bins,
            measured,
        )


def one_by_one(poses: WholePoses) -> DataLoader[RangeSlices]:
    """Return a loader of whole poses that leaves the caller's random numbers alone."""
    return DataLoader(poses, batch_size=None, generator=torch.Generator())
