# SPDX-License-Identifier: MIT
"""The progress and the checkpoints of a fit."""

from __future__ import annotations

import math
import signal
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from types import FrameType
from typing import Any

import lightning

from sononerf.errors import StoppedError
from sononerf.progress import Task


class ProgressCallback(lightning.Callback):
    """Moves a bar with every step."""

    def __init__(self, task: Task) -> None:
        self.task = task

    def on_train_start(
        self, trainer: lightning.Trainer, pl_module: lightning.LightningModule
    ) -> None:
        """Start where an interrupted fit stopped."""
        del pl_module
        self.task.advance(trainer.global_step)

    def on_train_batch_end(
        self,
        trainer: lightning.Trainer,
        pl_module: lightning.LightningModule,
        outputs: Any,
        batch: Any,
        batch_idx: int,
    ) -> None:
        """Count a step; the error on the validation poses stands behind the bar."""
        del pl_module, outputs, batch, batch_idx
        note = f"epoch {trainer.current_epoch + 1} of {trainer.max_epochs}"
        error = trainer.callback_metrics.get("val/mae_db")
        if error is not None:
            note += f", validation {float(error):.2f} dB"
        self.task.advance(note=note)


SIGNALS = (signal.SIGINT, signal.SIGTERM, signal.SIGHUP)


class CheckpointCallback(lightning.Callback):
    """Keeps ``checkpoints/last.ckpt``; the fit resumes at its step."""

    def __init__(self, folder: Path, seconds: float) -> None:
        self.path = folder / "checkpoints" / "last.ckpt"
        self.seconds = seconds
        self.stopped_by: int | None = None
        self._saved = self._began = time.monotonic()
        self._earlier = 0.0
        self._total = math.inf
        self._before: dict[signal.Signals, Callable[..., Any] | int] = {}

    @property
    def elapsed(self) -> float:
        """Seconds of fitting so far, those before an interruption included."""
        return self._earlier + time.monotonic() - self._began

    def state_dict(self) -> dict[str, float]:
        """Return the state of this callback, for a checkpoint."""
        return {"elapsed": self.elapsed}

    def load_state_dict(self, state_dict: dict[str, float]) -> None:
        """Go on counting where the interrupted fit stopped."""
        self._earlier = float(state_dict["elapsed"])
        self._began = time.monotonic()

    @contextmanager
    def watching(self) -> Iterator[None]:
        """Turn signals into an orderly stop; a second signal has its usual effect."""
        if threading.current_thread() is threading.main_thread():
            for number in SIGNALS:
                handler = signal.getsignal(number)
                # Signals that were ignored at the start (nohup, a shell's &) stay ignored.
                if handler is not None and handler is not signal.SIG_IGN:
                    self._before[number] = handler
        self._watch()
        try:
            yield
        finally:
            self._let_go()

    def _watch(self) -> None:
        for number in self._before:
            signal.signal(number, self._note)

    def _let_go(self) -> None:
        for number, handler in self._before.items():
            signal.signal(number, handler)

    def _note(self, number: int, frame: FrameType | None) -> None:
        del frame
        if self.stopped_by is not None:
            self._let_go()
            signal.raise_signal(number)
        self.stopped_by = number

    def _save(self, trainer: lightning.Trainer) -> None:
        trainer.save_checkpoint(self.path)
        self._saved = time.monotonic()

    def _stop(self, trainer: lightning.Trainer) -> None:
        # Lightning's own way of stopping validates once more first.
        raise StoppedError(
            self.stopped_by or signal.SIGTERM,
            f"stopped at step {trainer.global_step} of {self._total:.0f}; the same command goes on",
        )

    def _is_asked_to_stop(self, trainer: lightning.Trainer) -> bool:
        # All devices stop together; a fit that is over has nothing to stop.
        asked = trainer.strategy.reduce_boolean_decision(self.stopped_by is not None, all=False)
        return asked and trainer.global_step < self._total

    def on_train_start(
        self, trainer: lightning.Trainer, pl_module: lightning.LightningModule
    ) -> None:
        """Take SIGTERM back from Lightning, which would end with exit code 0."""
        del pl_module
        self._total = float(trainer.estimated_stepping_batches)
        self._watch()

    def on_train_epoch_end(
        self, trainer: lightning.Trainer, pl_module: lightning.LightningModule
    ) -> None:
        """Save the state after the epoch's validation."""
        del pl_module
        self._save(trainer)
        if self._is_asked_to_stop(trainer):
            self._stop(trainer)

    def on_train_batch_end(
        self,
        trainer: lightning.Trainer,
        pl_module: lightning.LightningModule,
        outputs: Any,
        batch: Any,
        batch_idx: int,
    ) -> None:
        """Save when it is time, or before stopping."""
        del pl_module, outputs, batch, batch_idx
        if trainer.is_last_batch or trainer.global_step >= self._total:
            # Saved after the epoch: Lightning would go on from here without its end, and would
            # count wrongly after another stop.
            return
        asked = self._is_asked_to_stop(trainer)
        late = time.monotonic() - self._saved >= self.seconds
        if asked or trainer.strategy.reduce_boolean_decision(late, all=False):
            self._save(trainer)
        if asked:
            self._stop(trainer)
