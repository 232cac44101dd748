# SPDX-License-Identifier: MIT
"""The LightningDataModule: batches of range slices, each a function of seed and number alone."""

from __future__ import annotations

from collections import OrderedDict
from collections.abc import Callable, Iterator, Mapping
from contextlib import nullcontext
from typing import Any, Literal, NamedTuple

import lightning
import numpy as np
import torch
from torch import Tensor
from torch.utils.data import DataLoader, Dataset, DistributedSampler

from sononerf.echoes.echoes import Echoes
from sononerf.echoes.memory_ensemble import Ensemble
from sononerf.errors import InputError, SettingsError
from sononerf.head.front_end import ACTIVE_DB
from sononerf.resources import may_start_processes, without_script
from sononerf.settings.loading import checked_section
from sononerf.settings.schema import DataSettings, FitSettings


class RangeSlices(NamedTuple):
    """A batch of slices, the same number from each of its poses."""

    pose: Tensor  # (P,) int, as numbered in the store
    position: Tensor  # (P, 3) m
    rotation: Tensor  # (P, 3, 3) head to world
    rows: Tensor  # (P, R) int, which range slices
    bins: Tensor  # (B,) int, which frequencies
    spectrum: Tensor  # (P, E, R, B) linear magnitude; no ears where nothing was measured


def _silent(spectrogram: Tensor, below: float) -> Tensor:
    """Return the mask (R,) of the slices of a pose (E, R, F) that are silent at all ears."""
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
        self.used_slices: Tensor | None = None  # which slices, where not all
        if silent_share < 1.0:
            if whole_poses:
                raise ValueError("whole poses are met with their silence")
            self.used_slices = self._used_slices(silent_share, silent_below, seed)
        every = len(self.poses) if whole_poses else len(self.poses) * self.ranges
        self.items = every if self.used_slices is None else len(self.used_slices)
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

    def __len__(self) -> int:
        """Steps in which every pose or slice is met once; the batches go on after them."""
        return -(-self.items // self.batch)

    def _used_slices(self, silent_share: float, silent_below: float, seed: int) -> Tensor:
        """Return the slices that sound and some of those that do not, ascending."""
        poses = self.poses.tolist()
        silent = torch.cat([_silent(self.reader[pose], silent_below) for pose in poses])
        sounding, rest = (mask.nonzero()[:, 0] for mask in (~silent, silent))
        generator = torch.Generator().manual_seed(seed_of(seed, 3))
        drawn = torch.randperm(len(rest), generator=generator)[: round(silent_share * len(rest))]
        return torch.cat((sounding, rest[drawn])).sort().values

    def _items_of(self, step: int) -> Tensor:
        turn, part = divmod(step, len(self))
        if self._order[0] != turn:
            generator = torch.Generator().manual_seed(seed_of(self.seed, 1, turn))
            self._order = (turn, torch.randperm(self.items, generator=generator))
        # The last batch of a pass is filled up from its beginning, so all have one size.
        index = torch.arange(part * self.batch, (part + 1) * self.batch) % self.items
        items = self._order[1][index][self.share[0] :: self.share[1]]
        return items if self.used_slices is None else self.used_slices[items]

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


LEAST_STEPS = 60
"""Least number of steps of an epoch. If there are few poses, an epoch passes over them several
times."""


class EpochSampler(DistributedSampler[int]):
    """The numbers of an epoch's batches; it begins at the step that the trainer has reached.

    A batch is a function of its number, so a fit that resumes in the middle of an epoch gets the
    remaining batches. Each device gets its share of each batch from the
    stream: as a ``DistributedSampler`` this one is not replaced by Lightning.
    """

    def __init__(self, steps: int, done: Callable[[], int]) -> None:
        self.steps, self.done = steps, done

    def set_epoch(self, epoch: int) -> None:
        """Do nothing: the step decides the batches, not the epoch."""

    def __len__(self) -> int:
        return self.steps

    def __iter__(self) -> Iterator[int]:
        first = self.done()
        return iter(range(first, (first // self.steps + 1) * self.steps))


class EpochLoader(DataLoader[RangeSlices]):
    """Loads the batches of an :class:`EpochSampler`, which needs no state to resume."""

    def __iter__(self) -> Any:
        """Start the workers; they do not run the script of the user again."""
        with without_script() if self.num_workers else nullcontext():
            return super().__iter__()

    def state_dict(self) -> dict[str, Any]:
        """Return no state. With this method Lightning knows that it can resume within an epoch."""
        return {}

    def load_state_dict(self, state_dict: dict[str, Any]) -> None:
        """Do nothing."""


class EchoDataModule(lightning.LightningDataModule):
    """Streams the batches of echoes to any Lightning Trainer; the splits are those of the echoes.

    A batch is a function of the seed and its number alone: neither the number of workers nor of
    devices changes it, and a resumed fit gets the remaining batches.

    Args:
        echoes: The echoes to fit.
        options: Sizes of batches and epochs, and the seed: keys of the section ``fit`` of the
            settings, such as ``{"batch_poses": 8, "steps_per_epoch": 100}``. Those of the module
            that is fitted by default.
        whole_poses: True for batches of whole poses, False for batches of single slices; what the
            renderer of the module wants by default.
        workers: Processes that prepare batches.
        memory_bytes: Largest part of the echoes that is kept in memory, bytes.

    Raises:
        SettingsError: If an option is not allowed.
    """

    def __init__(
        self,
        echoes: Echoes,
        options: FitSettings | Mapping[str, Any] | None = None,
        *,
        whole_poses: bool | None = None,
        workers: int = DataSettings.model_fields["workers"].default,
        memory_bytes: int = DataSettings.model_fields["memory_bytes"].default,
    ) -> None:
        super().__init__()
        if not hasattr(echoes, "store"):
            raise InputError(f"echoes is a {type(echoes).__name__}, expected an Echoes")
        self.echoes = echoes
        self.store = echoes.store
        self.workers = workers
        self.memory_bytes = memory_bytes
        self._options = None if options is None else checked_section(FitSettings, options, "fit")
        self._whole_poses = whole_poses

    @property
    def options(self) -> FitSettings:
        """The options that were given, or those of the module that is fitted."""
        if self._options is not None:
            return self._options
        found = getattr(self._module, "options", None)
        return found if isinstance(found, FitSettings) else FitSettings()

    @property
    def whole_poses(self) -> bool:
        """Whether batches are of whole poses."""
        if self._whole_poses is not None:
            return self._whole_poses
        return bool(getattr(getattr(self._module, "renderer", None), "whole_poses", True))

    @property
    def _module(self) -> lightning.LightningModule | None:
        return None if self.trainer is None else self.trainer.lightning_module

    @property
    def steps_per_epoch(self) -> int:
        """Training batches of an epoch."""
        return self._epoch_of(self.stream())

    def _epoch_of(self, stream: SliceStream) -> int:
        wanted = self.options.steps_per_epoch
        steps = max(len(stream), LEAST_STEPS) if wanted == "auto" else wanted
        most = -1 if self.trainer is None else self.trainer.max_steps
        return steps if most < 0 else min(steps, max(most, 1))

    def stream(self) -> SliceStream:
        """Return this device's share of the training batches."""
        trainer = self.trainer
        share = (trainer.global_rank, trainer.world_size) if trainer is not None else (0, 1)
        options, whole = self.options, self.whole_poses
        bins = options.batch_frequencies
        return SliceStream(
            self.store,
            "train",
            whole_poses=whole,
            batch=options.batch_poses if whole else options.batch_slices,
            batch_frequencies=None if bins == "all" else bins,
            seed=options.seed,
            memory_bytes=self.memory_bytes,
            share=share,
            silent_share=options.silent_share,
            silent_below=self.echoes.reference * (10 ** (ACTIVE_DB / 20) - 1),
        )

    def whole(self, split: Literal["train", "val", "test"]) -> WholePoses:
        """Return the poses of a split, one by one, with their measured spectra."""
        numbers = torch.as_tensor(self.store.indices(split))
        return WholePoses(
            torch.as_tensor(self.store.positions)[numbers],
            torch.as_tensor(self.store.rotations)[numbers],
            len(self.store.range),
            len(self.store.frequency),
            PoseReader(self.store, self.memory_bytes // 4),
            numbers,
        )

    def transfer_batch_to_device(
        self, batch: Any, device: torch.device, dataloader_idx: int
    ) -> Any:
        """Leave a batch where it is on a CPU: Lightning would look through its parts each step."""
        if device.type == "cpu":
            return batch
        return super().transfer_batch_to_device(batch, device, dataloader_idx)

    def train_dataloader(self) -> DataLoader[RangeSlices]:
        """Return the training batches of an epoch."""
        trainer = self.trainer

        def done() -> int:
            return 0 if trainer is None else trainer.global_step * trainer.accumulate_grad_batches

        stream = self.stream()
        workers = self.workers if may_start_processes() else 0
        return EpochLoader(
            stream,
            batch_size=None,
            sampler=EpochSampler(self._epoch_of(stream), done),
            generator=torch.Generator(),
            num_workers=workers,
            # A forked child may hang on the store's threads.
            multiprocessing_context="spawn" if workers else None,
            persistent_workers=workers > 0,
        )

    def val_dataloader(self) -> DataLoader[RangeSlices] | list[DataLoader[RangeSlices]]:
        """Return the validation poses; an empty list if there are none."""
        whole = self.whole("val")
        return one_by_one(whole) if len(whole) else []

    def test_dataloader(self) -> DataLoader[RangeSlices]:
        """Return the test poses."""
        return one_by_one(self.whole("test"))

    def predict_dataloader(self) -> DataLoader[RangeSlices]:
        """Return the test poses."""
        return self.test_dataloader()
