# SPDX-License-Identifier: MIT
"""Once in every epoch of ours, whatever Lightning counts."""

from __future__ import annotations

import lightning
import pytest

from sononerf.callbacks.epoch import EpochCallback, echo_module


class Record(EpochCallback):
    """Notes when it is called."""

    def __init__(self, save_at=None, path=None):
        self.seen, self.save_at, self.path = [], save_at, path

    def on_epoch(self, trainer, module, epoch):
        self.seen.append((epoch, module.global_step, "val/mae_db" in trainer.callback_metrics))
        if epoch == self.save_at:
            trainer.save_checkpoint(self.path)


def test_once_after_each_epochs_validation(training):
    record = Record()
    training(record).train()
    assert record.seen == [(1, 4, True), (2, 8, True)]


def test_once_after_each_epoch_without_validation(training):
    record = Record()
    training(record, validation=False).train()
    assert record.seen == [(1, 4, False), (2, 8, False)]


def test_not_while_sanity_checking(training):
    record = Record()
    made = training(record, sanity=1)
    made.train()
    assert record.seen == [(1, 4, True), (2, 8, True)]
    made.trainer.sanity_checking = True  # at a boundary
    record.on_validation_end(made.trainer, made.module)
    assert len(record.seen) == 2


@pytest.mark.parametrize("validation", [True, False])
def test_after_resuming_at_a_boundary_only_what_is_left(training, tmp_path, validation):
    training(Record(1, tmp_path / "c.ckpt"), validation=validation).train()
    record = Record()
    training(record, validation=validation, start=4).train(tmp_path / "c.ckpt")
    assert [seen[:2] for seen in record.seen] == [(2, 8)]


def test_a_module_of_another_kind_is_refused(training):
    with pytest.raises(TypeError, match="is no EchoModule"):
        echo_module(lightning.LightningModule())
    module = training().module
    assert echo_module(module) is module


def test_what_is_done_each_epoch_must_be_said():
    with pytest.raises(NotImplementedError):
        EpochCallback().on_epoch(None, None, 1)
