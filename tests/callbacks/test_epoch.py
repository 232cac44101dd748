# SPDX-License-Identifier: MIT
"""Checkpoints after each epoch, after so many seconds, and when a signal asks."""

from __future__ import annotations

import os
import signal

import lightning
import pytest

from sononerf.callbacks import CheckpointCallback
from sononerf.errors import StoppedError
from sononerf.field.checkpoint_io import DurableCheckpointIO


class Kill(lightning.Callback):
    """Sends signals at the end of a step, or at the end of a validation."""

    def __init__(self, step, *numbers, validating=False):
        self.step, self.numbers, self.validating = step, numbers, validating

    def _send(self, module):
        if module.global_step == self.step:
            for number in self.numbers:
                os.kill(os.getpid(), number)

    def on_train_batch_end(self, trainer, pl_module, *rest):
        if not self.validating:
            self._send(pl_module)

    def on_validation_batch_end(self, trainer, pl_module, *rest):
        if self.validating:
            self._send(pl_module)
            self.step = -1


def saved(folder):
    return DurableCheckpointIO().load_checkpoint(folder / "checkpoints" / "last.ckpt")[
        "global_step"
    ]


class Steps(lightning.Callback):
    """Notes at which steps a checkpoint is saved."""

    def __init__(self):
        self.seen = []

    def on_save_checkpoint(self, trainer, pl_module, checkpoint):
        self.seen.append(checkpoint["global_step"])


def test_after_every_epoch(training, tmp_path):
    steps = Steps()
    training(CheckpointCallback(tmp_path, 60.0), steps).train()
    assert steps.seen == [4, 8]
    assert sorted(p.name for p in (tmp_path / "checkpoints").iterdir()) == ["last.ckpt"]


def test_the_time_of_a_fit_begins_at_zero(tmp_path):
    assert 0 <= CheckpointCallback(tmp_path, 60.0).elapsed < 0.5


def test_every_so_many_seconds_and_at_a_boundary_once(training, tmp_path):
    steps = Steps()
    training(CheckpointCallback(tmp_path, 1e-9), steps).train()
    assert steps.seen == list(range(1, 9))


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM, signal.SIGHUP])
def test_a_signal_stops_after_the_step(training, tmp_path, number):
    keeper = CheckpointCallback(tmp_path, 60.0)
    made = training(Kill(2, number), keeper)
    with keeper.watching(), pytest.raises(StoppedError, match="step 2 of 8") as caught:
        made.train()
    assert caught.value.exit_code == 128 + number
    assert saved(tmp_path) == 2
