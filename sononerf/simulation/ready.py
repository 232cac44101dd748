# SPDX-License-Identifier: MIT
# ruff: noqa: E402 - numerical libraries read the environment when they are imported
"""Imported by the process that workers are forked from, so that each has all compiled loops."""

from __future__ import annotations

import os

THREADS = ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS")
os.environ.update(dict.fromkeys(THREADS, "1"))  # each worker uses one core

import numpy as np
import trimesh

from sononerf.head.head import Head
from sononerf.scene.scene import Scene
from sononerf.settings.schema import (
    AirSettings,
    CallSettings,
    EarSettings,
    NoiseSettings,
    SimulationSettings,
    SpectrogramSettings,
)
from sononerf.simulation.simulator import Simulator


def trace_once() -> None:
    """Trace a few rays off two spheres that shade each other, so that all loops are compiled."""
    balls = [trimesh.creation.icosphere(1, radius=0.02) for _ in range(2)]
    balls[1].apply_translation([-0.05, 0.0, 0.01])
    options = SimulationSettings(engine="rays", rays=300)
    head = Head(
        ears=EarSettings(),
        call=CallSettings(),
        air=AirSettings(),
        spectrogram=SpectrogramSettings(),
        noise=NoiseSettings(),
    )
    simulator = Simulator(Scene(trimesh.util.concatenate(balls), warns=False), head, options)
    simulator.spectrogram(np.array([-0.4, 0.0, 0.0]), np.eye(3), seed=0)


trace_once()
