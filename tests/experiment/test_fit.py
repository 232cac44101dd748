# SPDX-License-Identifier: MIT
"""A fit that is interrupted, however often and wherever, ends where the uninterrupted one ends."""

from __future__ import annotations

import json
import os
import signal

import pytest
import safetensors.torch
import torch

from sononerf.callbacks.checkpoint import SIGNALS, CheckpointCallback
from sononerf.errors import StoppedError
from sononerf.experiment.fit import fit

STEPS = 12  # of three epochs


@pytest.fixture
def interrupt(monkeypatch):
    """Send a signal to ourselves at the end of a step."""
    real = CheckpointCallback.on_train_batch_end
    wanted = {}

    def on_train_batch_end(self, trainer, pl_module, *rest):
        number = wanted.pop(pl_module.global_step, None)
        if number is not None:
            os.kill(os.getpid(), number)
        real(self, trainer, pl_module, *rest)

    monkeypatch.setattr(CheckpointCallback, "on_train_batch_end", on_train_batch_end)

    def at(step, number=signal.SIGTERM):
        wanted.clear()
        wanted[step] = number

    return at


def what_a_run_holds(path):
    """Weights as bits, steps, and what each epoch measured."""
    epochs = sorted((path / "epochs").iterdir())
    return {
        "weights": {
            name: (str(tensor.dtype), tuple(tensor.shape), tensor.numpy().tobytes())
            for name, tensor in safetensors.torch.load_file(path / "model.safetensors").items()
        },
        "epochs": {p.name: json.loads((p / "metrics.json").read_text()) for p in epochs},
        "meshes": {p.name: (p / "mesh.ply").is_file() for p in epochs},
        "steps": json.loads((path / "metrics.json").read_text())["cost"]["steps"],
    }


def fit_with_stops(settings, path, interrupt, stops, number=signal.SIGTERM):
    for step in stops:
        interrupt(step, number)
        with pytest.raises(StoppedError, match=f"stopped at step {step} of {STEPS}") as caught:
            fit(settings, path, accelerator="cpu")
        assert caught.value.exit_code == 128 + number
        assert not (path / "model.json").exists()
    interrupt(0)
    fit(settings, path, accelerator="cpu")
    return what_a_run_holds(path)


@pytest.fixture(scope="module")
def through(echoes, tmp_path_factory):
    """The uninterrupted fit."""
    from tests_experiment_conftest import tiny_settings  # placeholder
