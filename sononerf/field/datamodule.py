# SPDX-License-Identifier: MIT
"""The LightningDataModule: streams range slices from an ensemble store."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any, Literal

import lightning
import torch
from torch.utils.data import DataLoader, Sampler

from sononerf.echoes.store import EnsembleStore
from sononerf.field.range_slices import PoseReader, RangeSlices, SliceStream, WholePoses


class StepSampler(Sampler[int]):
    """Counts steps without end; ``start`` is where an interrupted fit goes on."""

    def __init__(self) -> None:
        self.start = 0

    def __iter__(self) -> Iterator[int]:
        step = self.start
        while True:
            yield step
            step += 1


class EchoDataModule(lightning.LightningDataModule):
    """Streams batches; the splits are the store's, by pose.

    Args:
        store: A sealed ensemble.
        whole_poses: What the renderer wants: whole poses or single slices.
        batch: Poses or slices per training batch, over all devices together.
        batch_frequencies: Frequencies per training batch; all where None.
        seed: Turns the order of the training batches.
        workers: Processes that prepare batches; the batches do not depend on it.
        memory_bytes: How much of the ensemble may be kept in memory.
        silent_share, silent_below: Which part of the silent slices is met, and what magnitude no
            cell of these reaches.
    """

    def __init__(
        self,
        store: EnsembleStore,
        *,
        whole_poses: bool,
        batch: int,
        batch_frequencies: int | None,
        seed: int,
        workers: int = 0,
        memory_bytes: int = 2_000_000_000,
        silent_share: float = 1.0,
        silent_below: float = 0.0,
    ) -> None:
        super().__init__()
        self.store = store
        self.whole_poses = whole_poses
        self.batch = batch
        self.batch_frequencies = batch_frequencies
        self.seed = seed
        self.workers = workers
        self.memory_bytes = memory_bytes
        self.silent_share = silent_share
        self.silent_below = silent_below
        self.sampler = StepSampler()

    def stream(self) -> SliceStream:
        """Return this device's share of the training batches."""
        trainer = self.trainer
        share = (trainer.global_rank, trainer.world_size) if trainer is not None else (0, 1)
        return SliceStream(
            self.store,
            "train",
            whole_poses=self.whole_poses,
            batch=self.batch,
            batch_frequencies=self.batch_frequencies,
            seed=self.seed,
            memory_bytes=self.memory_bytes,
            share=share,
            silent_share=self.silent_share,
            silent_below=self.silent_below,
        )

    def whole(self, split: Literal["train", "val", "test"]) -> WholePoses:
        """Return the poses of a split, one by one, with what was measured there."""
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

    def _loader(
        self, dataset: SliceStream | WholePoses, sampler: Sampler[int] | None
    ) -> DataLoader[RangeSlices]:
        endless = sampler is not None
        return DataLoader(
            dataset,
            batch_size=None,
            sampler=sampler,
            num_workers=self.workers if endless else 0,
            # A forked child may hang on the store's threads.
            multiprocessing_context="spawn" if self.workers and endless else None,
            persistent_workers=bool(self.workers and endless),
        )

    def train_dataloader(self) -> DataLoader[RangeSlices]:
        """Return the endless stream of training batches."""
        return self._loader(self.stream(), self.sampler)

    def val_dataloader(self) -> DataLoader[RangeSlices] | list[DataLoader[RangeSlices]]:
        """Return the validation poses, or nothing where there are none."""
        whole = self.whole("val")
        return self._loader(whole, None) if len(whole) else []

    def test_dataloader(self) -> DataLoader[RangeSlices]:
        """Return the test poses."""
        return self._loader(self.whole("test"), None)

    def predict_dataloader(self) -> DataLoader[RangeSlices]:
        """Return the test poses."""
        return self.test_dataloader()
