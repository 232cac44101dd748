# SPDX-License-Identifier: MIT
"""Every step moves the bar."""

from __future__ import annotations

import lightning

from sononerf.callbacks import ProgressCallback


class Task:
    """Notes what it is told."""

    def __init__(self):
        self.done, self.notes = 0, []

    def advance(self, count=1, note=None):
        self.done += count
        if note is not None:
            self.notes.append(note)


class Save(lightning.Callback):
    """Keeps the first epoch."""

    def __init__(self, path):
        self.path = path

    def on_train_epoch_end(self, trainer, pl_module):
        if trainer.current_epoch == 0:
            trainer.save_checkpoint(self.path)


def test_a_count_per_step_and_the_error_behind_it(training):
    task = Task()
    training(ProgressCallback(task)).train()
    assert task.done == 8
    assert [note.split(",")[0] for note in task.notes] == [
        *["epoch 1 of 2"] * 4,
        *["epoch 2 of 2"] * 4,
    ]
    assert "validation" not in task.notes[3]
    assert task.notes[4].startswith("epoch 2 of 2, validation ")
    assert task.notes[4].endswith(" dB")


def test_a_resumed_fit_starts_where_it_stopped(training, tmp_path):
    training(Save(tmp_path / "c.ckpt")).train()
    task = Task()
    training(ProgressCallback(task)).train(tmp_path / "c.ckpt")
    assert task.done == 8
    assert len(task.notes) == 4
