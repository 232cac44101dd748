# SPDX-License-Identifier: MIT
"""Checkpoints after every epoch, every so many seconds, and when the fit is asked to stop."""

from __future__ import annotations

import signal
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from types import FrameType
from typing import Any

import lightning

from sononerf.callbacks.epoch import EpochCallback
from sononerf.module import EchoModule

SIGNALS = (signal.SIGINT, signal.SIGTERM, signal.SIGHUP)


class CheckpointCallback(EpochCallback):
    """Keeps ``checkpoints/last.ckpt``; the step it holds is where the fit goes on.

    Parameters
    ----------
    folder : Path
        The run.
    seconds : float
        Longest time between two checkpoints.
    """

    def __init__(self, folder: Path, seconds: float) -> None:
        self.path = folder / "checkpoints" / "last.ckpt"
        self.seconds = seconds
        self.stopped_by: int | None = None
        self._saved = time.monotonic()

    @contextmanager
    def watching(self) -> Iterator[None]:
        """Turn signals into an orderly stop; a second one stops at once."""

        def note(number: int, frame: FrameType | None) -> None:
            del frame
            if self.stopped_by is not None:
                raise KeyboardInterrupt
            self.stopped_by = number

        # What was ignored when we were started (nohup, a shell's &) stays ignored.
        before = {s: signal.getsignal(s) for s in SIGNALS}
        for number, handler in before.items():
            if handler is not signal.SIG_IGN:
                signal.signal(number, note)
        try:
            yield
        finally:
            for number, handler in before.items():
                signal.signal(number, handler)

    def _save(self, trainer: lightning.Trainer) -> None:
        trainer.save_checkpoint(self.path)
        self._saved = time.monotonic()

    def on_epoch(self, trainer: lightning.Trainer, module: EchoModule, epoch: int) -> None:
        """Save what the epoch reached."""
        del module, epoch
        self._save(trainer)

    def on_train_batch_end(
        self,
        trainer: lightning.Trainer,
        pl_module: lightning.LightningModule,
        outputs: Any,
        batch: Any,
        batch_idx: int,
    ) -> None:
        """Save when it is time, or when asked to stop."""
        super().on_train_batch_end(trainer, pl_module, outputs, batch, batch_idx)
        if self.stopped_by is not None:
            self._save(trainer)
            trainer.should_stop = True
        elif time.monotonic() - self._saved >= self.seconds:
            self._save(trainer)
