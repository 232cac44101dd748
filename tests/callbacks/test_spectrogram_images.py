# SPDX-License-Identifier: MIT
"""Measured and predicted spectrograms, in TensorBoard alone."""

from __future__ import annotations

import io

import lightning
import torch
from PIL import Image
from tensorboard.backend.event_processing.event_accumulator import EventAccumulator

from sononerf import callbacks as images_module
from sononerf import callbacks as tensorboard_module
from sononerf.callbacks import SpectrogramImages


def callback(made, poses=None):
    renderer = made.module.renderer
    poses = made.data.whole("val") if poses is None else poses
    return SpectrogramImages(poses, renderer.range, renderer.frequency)


class Modes(lightning.Callback):
    """Notes whether each step is taken in training mode."""

    def __init__(self):
        self.seen = []

    def on_train_batch_start(self, trainer, pl_module, *rest):
        self.seen.append(pl_module.training and pl_module.renderer.training)


def test_one_picture_per_epoch(training, tmp_path):
    modes = Modes()
    made = training(modes, logger=True, validation=False)  # it would put training mode back
    made.trainer.callbacks.append(callback(made))
    made.train()
    assert modes.seen == [True] * 8
    events = EventAccumulator(str(tmp_path / "tensorboard" / tmp_path.name))
    events.Reload()
    assert events.Tags()["images"] == [f"spectrogram/validation_pose_{n}" for n in (0, 1)]
    pictures = events.Images("spectrogram/validation_pose_1")
    assert pictures[-1].step == 8
    with Image.open(io.BytesIO(pictures[0].encoded_image_string)) as image:
        assert min(image.size) > 100


def test_some_epochs_and_the_last_one_have_pictures(training, monkeypatch):
    shown = []
    made = training(logger=True, validation=False, steps=28)

    def draw(*given):
        shown.append(made.trainer.current_epoch + 1)
        return torch.zeros(2, 2, 3, dtype=torch.uint8).numpy()

    monkeypatch.setattr(images_module, "quick_image", draw)
    made.trainer.callbacks.append(callback(made))
    made.train()
    assert shown == [5, 5, 7, 7]


def test_the_same_validation_poses_are_shown_each_time(training, monkeypatch):
    monkeypatch.setattr(tensorboard_module, "PICTURES", 1)
    monkeypatch.setattr(images_module, "sounding_slice", lambda *given: slice(None))
    shown = []

    def draw(levels, range_m, frequency_hz):
        shown.append((levels["measured"], levels["predicted"], range_m, frequency_hz))
        return torch.zeros(2, 2, 3, dtype=torch.uint8).numpy()

    monkeypatch.setattr(images_module, "quick_image", draw)
    made = training(logger=True)
    made.trainer.callbacks.append(callback(made))
    made.train()
    store = made.data.store
    heard = [torch.from_numpy(store.read_pose(int(n))) for n in store.indices("val")]
    expected = [20 * torch.log10(1 + one / store.attributes["reference"]) for one in heard]
    assert len(shown) == 4
    for number, (measured, predicted, range_m, frequency_hz) in enumerate(shown):
        torch.testing.assert_close(torch.from_numpy(measured), expected[number % 2])
        assert predicted.shape == measured.shape == (2, len(range_m), len(frequency_hz))


def test_nothing_without_poses_or_without_tensorboard(training, monkeypatch):
    drawn = []
    monkeypatch.setattr(images_module, "quick_image", lambda *given: drawn.append(given))
    made = training(logger=True)
    made.trainer.callbacks.append(callback(made, poses=[]))
    made.train()
    made = training()
    made.trainer.callbacks.append(callback(made))
    made.train()
    assert drawn == []
