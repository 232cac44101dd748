# SPDX-License-Identifier: MIT
"""How far the engines are from exact multiple scattering, and what they put before an echo."""

from __future__ import annotations

import argparse
import time
from typing import Any

import numpy as np
from numpy.typing import NDArray

BANDS = ((10e3, 25e3), (25e3, 41e3), (41e3, 80e3))
SETTINGS = {"spectrogram": {"frequency_max": 80e3}, "poses": {"count": 100}}
WITHIN = 20.0  # dB below the loudest cell of a pose
LOUD = 15.0  # dB below it, where an echo counts as loud
EARLY = (0.012, 0.070)  # m before the first loud range
NEAR = 0.010  # m before the nearest point of the scene


def exact(arguments: argparse.Namespace) -> dict[str, Any]:
    """Compare engines with the exact echoes of a scene of spheres, by band."""
    truth = _heard(arguments.scene, "spheres", arguments.poses)
    rows = [_before("spheres", truth, truth["reference"])]
    for engine in arguments.engines:
        found = _heard(arguments.scene, engine, arguments.poses)
        rows.append(_before(engine, found, truth["reference"]) | _errors(found, truth))
    return {"scene": arguments.scene, "poses": arguments.poses, "rows": rows}


def _heard(scene: str, engine: str, poses: int) -> dict[str, Any]:
    """Return spectrograms (P, E, R, F) of the first test poses, and what goes with them."""
    from sononerf.run.build import simulator_of
    from sononerf.scene.scene import load_scene
    from sononerf.settings.loading import validate_settings
    from sononerf.simulation.simulator import ensemble_poses, pose_seed

    data = SETTINGS | {"scene": {"name": scene}, "simulation": {"engine": engine}}
    settings = validate_settings(data, "benchmark exact")
    simulator = simulator_of(load_scene(scene), settings)
    all_poses, split = ensemble_poses(settings.poses)
    chosen = np.flatnonzero(split == 2)[:poses]
    places, turns = all_poses.positions[chosen], all_poses.rotations[chosen]
    started = time.perf_counter()
    simulator.engine.prepare(places, turns)
    solved = time.perf_counter() - started
    magnitude = np.stack(
        [
            simulator.receive(place, turn, seed=pose_seed(0, int(index)))[1]
            for index, place, turn in zip(chosen, places, turns, strict=True)
        ]
    )
    nearest = np.zeros(magnitude.shape[:2])
    for pose, (place, turn) in enumerate(zip(places, turns, strict=True)):
        emitter, ears = simulator.engine.hearing.places(place, turn)
        nearest[pose] = simulator.engine.arrival.shortest(emitter[None], ears[None])[0] / 2.0
    return {
        "magnitude": magnitude,
        "reference": 1e-3 * float(magnitude.max()),
        "range": simulator.head.range,
        "frequency": simulator.head.frequency,
        "nearest": nearest,
        "solved_s": solved,
        "pose_s": (time.perf_counter() - started - solved) / len(chosen),
    }


def _before(engine: str, found: dict[str, Any], reference: float) -> dict[str, Any]:
    """Return levels above m0 before the first loud echo, and before the nearest point."""
    from sononerf.head.decibels import compress

    level, distance = compress(found["magnitude"], reference), found["range"]
    worst, mean, near = 0.0, [], 0.0
    for heard, nearest in zip(level, found["nearest"], strict=True):
        decibels = 20.0 * np.log10(np.expm1(heard * np.log(10.0) / 20.0) + 1e-12)
        loud = (decibels > decibels.max() - LOUD).any(axis=(0, 2))
        first = distance[loud.argmax()]
        early = (distance > first - EARLY[1]) & (distance < first - EARLY[0])
        worst = max(worst, float(heard[:, early].max()))
        mean.append(float(heard[:, early].mean()))
        for ear, nearest_of_ear in zip(heard, nearest, strict=True):
            near = max(near, float(ear[distance < nearest_of_ear - NEAR].max(initial=0.0)))
    row = {"engine": engine, "early_worst_db": worst, "early_mean_db": max(mean)}
    return row | {"near_worst_db": near, "solved_s": found["solved_s"], "pose_s": found["pose_s"]}


def _errors(found: dict[str, Any], truth: dict[str, Any]) -> dict[str, Any]:
    """Return mean error and bias of cells near the loudest, by band, and over all cells."""
    from sononerf.head.decibels import compress

    reference = truth["reference"]
    error = compress(found["magnitude"], reference) - compress(truth["magnitude"], reference)
    true: NDArray[np.float64] = truth["magnitude"]
    near = true > true.max(axis=(1, 2, 3), keepdims=True) * 10 ** (-WITHIN / 20.0)
    frequency, row = truth["frequency"], {}
    step = frequency[1] - frequency[0]
    for low, high in BANDS:
        cells = near & (frequency >= low - step / 2) & (frequency < high)
        name = f"{low / 1e3:.0f}_to_{high / 1e3:.0f}_khz"
        row[f"{name}_db"] = float(np.abs(error[cells]).mean())
        row[f"{name}_bias_db"] = float(error[cells].mean())
    by_frequency = [
        [round(float(f)), round(float(np.abs(error[..., i][near[..., i]]).mean()), 2)]
        for i, f in enumerate(frequency)
        if near[..., i].any()
    ]
    return row | {"all_db": float(np.abs(error).mean()), "by_frequency": by_frequency}
