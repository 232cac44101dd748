# SPDX-License-Identifier: MIT
"""Time and memory of a fit, measured on a part of its first batch."""

from __future__ import annotations

import copy
import time
from dataclasses import dataclass

import torch
from torch import Tensor

from sononerf.field.datamodule import EchoDataModule
from sononerf.field.module import EchoModule
from sononerf.field.range_slices import RangeSlices

STATES = 4
"""Numbers kept per parameter, no unit: its value, its gradient, and Adam's two averages."""
WORKSPACE = 2.0
"""Memory of a backward pass over the memory of the values it needs, no unit: gradients are as large
as values."""


@dataclass(frozen=True)
class StepCost:
    """Cost of one training step.

    Attributes:
        memory: Bytes of parameters and of the backward pass's values.
        seconds: Duration on this machine's CPU.
    """

    memory: float
    seconds: float


def step_cost(module: EchoModule, data: EchoDataModule) -> StepCost:
    """Measure one item of a batch, and scale it to the whole batch.

    The module's random numbers, parameters and buffers stay as they are; a copy is used.
    """
    batch = data.stream()[0]
    part = RangeSlices(
        batch.pose[:1],
        batch.position[:1],
        batch.rotation[:1],
        batch.rows[:1],
        batch.bins,
        batch.spectrum[:1],
    )
    trial = copy.deepcopy(module)
    parameters = [each for each in trial.parameters() if each.requires_grad]
    sizes: dict[int, int] = {}

    def count(values: Tensor) -> Tensor:
        storage = values.untyped_storage()
        sizes[storage.data_ptr()] = storage.nbytes()
        return values

    seconds = 0.0
    with torch.random.fork_rng([]):
        trial.field.advance(0, 1)
        trial.renderer.advance(0, 1)
        trial.renderer.prepare(trial.field, trial.possible, 0)
        for _ in range(2):  # the first pass includes compiling
            sizes.clear()
            begun = time.monotonic()
            with torch.autograd.graph.saved_tensors_hooks(count, lambda values: values):
                predicted = trial(part)
            torch.autograd.grad(predicted.sum(), parameters, allow_unused=True)
            seconds = time.monotonic() - begun
    own = {each.untyped_storage().data_ptr() for each in parameters}
    saved = sum(size for place, size in sizes.items() if place not in own)
    fixed = STATES * sum(each.numel() * each.element_size() for each in parameters)
    items = len(batch.pose)
    return StepCost(fixed + WORKSPACE * items * saved, items * seconds)
