# SPDX-License-Identifier: MIT
"""Measured and predicted spectrograms, in TensorBoard alone."""

from __future__ import annotations

import io

import lightning
from PIL import Image
from tensorboard.backend.event_processing.event_accumulator import EventAccumulator

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
