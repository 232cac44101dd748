# SPDX-License-Identifier: MIT
"""Checkpoints after each epoch, after so many seconds, and when a signal asks."""

from __future__ import annotations

import os
import signal
import threading

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


def test_a_signal_during_validation_stops_after_it(training, tmp_path):
    keeper = CheckpointCallback(tmp_path, 60.0)
    made = training(Kill(4, signal.SIGTERM, validating=True), keeper)
    with keeper.watching(), pytest.raises(StoppedError, match="step 4 of 8"):
        made.train()
    assert saved(tmp_path) == 4


def test_a_second_signal_does_what_it_did_without_us(training, tmp_path, monkeypatch):
    class AtOnceError(BaseException):
        pass

    def unwind(number, frame):
        raise AtOnceError

    before = signal.signal(signal.SIGTERM, unwind)
    try:
        keeper = CheckpointCallback(tmp_path, 60.0)
        made = training(Kill(2, signal.SIGTERM, signal.SIGTERM), keeper)
        with keeper.watching(), pytest.raises(AtOnceError):
            made.train()
        assert signal.getsignal(signal.SIGTERM) is unwind
    finally:
        signal.signal(signal.SIGTERM, before)


def test_what_was_ignored_stays_ignored(training, tmp_path):
    before = signal.signal(signal.SIGHUP, signal.SIG_IGN)
    try:
        keeper = CheckpointCallback(tmp_path, 60.0)
        made = training(Kill(2, signal.SIGHUP), keeper)
        with keeper.watching():
            made.train()
        assert made.trainer.global_step == 8
        assert signal.getsignal(signal.SIGHUP) is signal.SIG_IGN
    finally:
        signal.signal(signal.SIGHUP, before)


def test_outside_the_main_thread_signals_are_left_alone(tmp_path):
    failed = []

    def watch():
        try:
            with CheckpointCallback(tmp_path, 60.0).watching():
                pass
        except ValueError as error:
            failed.append(error)

    thread = threading.Thread(target=watch)
    thread.start()
    thread.join()
    assert failed == []
