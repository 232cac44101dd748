# SPDX-License-Identifier: MIT
"""What each epoch leaves to look at, and how little it disturbs the fit."""

from __future__ import annotations

import io
import json
import os
import signal

import lightning
import pytest
import torch
import trimesh
from PIL import Image
from tensorboard.backend.event_processing.event_accumulator import EventAccumulator

from sononerf.callbacks import CheckpointCallback, PreviewCallback
from sononerf.errors import StoppedError
from sononerf.field.checkpoint_io import DurableCheckpointIO


def previews(folder, **changes):
    return PreviewCallback(folder, **{"every_epochs": 1, "voxels": 12, "directions": 20, **changes})


class Modes(lightning.Callback):
    """Notes whether each step is taken in training mode."""

    def __init__(self):
        self.seen = []

    def on_train_batch_start(self, trainer, pl_module, *rest):
        self.seen.append(
            pl_module.training and pl_module.field.training and pl_module.renderer.training
        )


def events_of(folder):
    events = EventAccumulator(str(folder / "tensorboard" / folder.name))
    events.Reload()
    return events


def loud(module):
    """Put a surface into the field from the first step on."""
    with torch.no_grad():
        grid = module.field.grids[0]
        middle = [size // 2 for size in grid.shape[2:]]
        grid[0, 0] = -12.0
        z, y, x = (slice(m - 1, m + 2) for m in middle)
        grid[0, 0, z, y, x] = 0.0
    return module


def test_mesh_projections_and_numbers(training, tmp_path):
    modes = Modes()
    made = training(previews(tmp_path / "run"), modes, logger=True)
    loud(made.module)
    made.train()
    folders = sorted((tmp_path / "run" / "epochs").iterdir())
    assert [p.name for p in folders] == ["0001", "0002"]
    for number, folder in enumerate(folders, start=1):
        assert {p.name for p in folder.iterdir()} == {
            "mesh.ply",
            "mip_x.png",
            "mip_y.png",
            "mip_z.png",
            "metrics.json",
        }
        assert len(trimesh.load_mesh(folder / "mesh.ply").faces) > 3
        for axis in "xyz":
            with Image.open(io.BytesIO((folder / f"mip_{axis}.png").read_bytes())) as image:
                assert min(image.size) >= 8
        numbers = json.loads((folder / "metrics.json").read_text())
        assert (numbers["epoch"], numbers["step"]) == (number, 4 * number)
        assert {"train/loss", "val/mae_db"} <= numbers.keys()
    assert modes.seen == [True] * 8
    events = events_of(tmp_path)
    assert events.Images("projections")[-1].step == 8
    assert {"mesh/field_VERTEX", "mesh/field_FACE"} <= set(events.Tags()["tensors"])


def test_training_mode_is_put_back(training, tmp_path):
    modes = Modes()
    training(previews(tmp_path), modes, validation=False).train()  # Lightning would put it back
    assert modes.seen == [True] * 8


def test_every_so_many_epochs(training, tmp_path):
    training(previews(tmp_path, every_epochs=2)).train()
    assert [p.name for p in (tmp_path / "epochs").iterdir()] == ["0002"]


def test_only_one_of_many_devices_writes(training, tmp_path):
    class Second:
        is_global_zero = False
        current_epoch = 0

    previews(tmp_path).on_train_epoch_end(Second(), training().module)
    assert list(tmp_path.iterdir()) == []


def test_the_fit_does_not_feel_it(training, tmp_path):
    with_them, without = training(previews(tmp_path)), training()
    with_them.train()
    without.train()
    for (name, first), second in zip(
        with_them.module.named_parameters(), without.module.parameters(), strict=True
    ):
        assert torch.equal(first, second), name


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
