# SPDX-License-Identifier: MIT
"""What a pose of a configuration costs, everything included, in CPU time."""

from __future__ import annotations

import argparse
import time
from typing import Any

import numpy as np

from sononerf.run.build import simulator_of
from sononerf.scene.scene import load_scene
from sononerf.settings.loading import load_settings
from sononerf.simulation.ensemble import pose_seed
from sononerf.simulation.simulator import ensemble_poses


def cost(arguments: argparse.Namespace) -> dict[str, Any]:
    """Take the CPU time of a configuration's poses: solving for all of them, tracing some."""
    settings = load_settings(arguments.config)
    simulator = simulator_of(load_scene(settings.scene.name, settings.scene.options), settings)
    poses, _ = ensemble_poses(settings.poses)
    start = time.process_time()
    simulator.engine.prepare(poses.positions, poses.rotations)
    solved = (time.process_time() - start) / len(poses)
    traced = []
    chosen = np.linspace(0, len(poses) - 1, min(arguments.poses, len(poses))).round().astype(int)
    for number in (0, *chosen.tolist()):  # the first call of all builds tables
        seed = pose_seed(settings.simulation.seed, number)
        start = time.process_time()
        simulator.spectrogram(poses.positions[number], poses.rotations[number], seed=seed)
        traced.append(time.process_time() - start)
    each = float(np.mean(traced[1:]))
    return {
        "config": str(arguments.config),
        "poses": len(poses),
        "solved_s": solved,
        "traced_s": each,
        "pose_s": solved + each,
    }
