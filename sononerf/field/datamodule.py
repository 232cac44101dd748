# SPDX-License-Identifier: MIT
"""The LightningDataModule: streams batches of range slices to a Trainer."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping
from typing import Any, Literal

import lightning
import torch
from torch.utils.data import DataLoader, DistributedSampler

from sononerf.echoes.echoes import Echoes
from sononerf.errors import InputError
from sononerf.field.range_slices import PoseReader, RangeSlices, SliceStream, WholePoses, one_by_one
from sononerf.head.decibels import ACTIVE_DB
from sononerf.settings.loading import checked_section
from sononerf.settings.schema import DataSettings, FitSettings

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
            that is fitted where None.
        whole_poses: True for batches of whole poses, False for batches of single slices; what the
            renderer of the module wants where None.
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
        steps = max(stream.batches_per_pass, LEAST_STEPS) if wanted == "auto" else wanted
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
        return EpochLoader(
            stream,
            batch_size=None,
            sampler=EpochSampler(self._epoch_of(stream), done),
            generator=torch.Generator(),
            num_workers=self.workers,
            # A forked child may hang on the store's threads.
            multiprocessing_context="spawn" if self.workers else None,
            persistent_workers=self.workers > 0,
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
