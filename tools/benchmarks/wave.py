# SPDX-License-Identifier: MIT
"""How far the engines are from solutions of the wave equation, on small bodies up to 40 kHz."""

from __future__ import annotations

import argparse
import time
from typing import Any

import numpy as np
from numpy.typing import NDArray

ANALYSIS = {"frequency_max": 40e3, "range_max": 0.6}
SOLVED = 48e3  # Hz
BANDS = ((10e3, 25e3), (25e3, 40e3))
DISTANCE = 0.35  # m
LEAF = {"length": 0.04, "width": 0.024, "thickness": 3e-4, "material": "rigid"}


def beaker(height: float = 0.04, radius: float = 0.012, wall: float = 1.5e-3) -> Any:
    """Return the mesh of a beaker that is open at its top (m), its middle in the origin."""
    import trimesh

    inner = radius - wall
    profile = [[0, 0], [radius, 0], [radius, height], [inner, height], [inner, wall], [0, wall]]
    mesh = trimesh.creation.revolve(np.array(profile), sections=64)
    mesh.apply_translation([0.0, 0.0, -height / 2.0])
    return mesh


def bodies() -> dict[str, Any]:
    """Return the scenes: spheres that are known exactly, a thin leaf, a hollow beaker."""
    import trimesh

    from sononerf.scene.material import RIGID
    from sononerf.scene.scene import Scene, load_scene
    from tests.simulation.listening import ball

    places = ((0.01, (0, 0, 0)), (0.008, (0.022, 0.004, 0)), (0.006, (0.006, 0.02, 0.01)))
    balls = trimesh.util.concatenate([ball(radius, middle) for radius, middle in places])
    return {
        "spheres": Scene(balls, RIGID),
        "leaf": load_scene("leaf", LEAF),
        "beaker": Scene(beaker(), RIGID),
    }


def wave(arguments: argparse.Namespace) -> dict[str, Any]:
    """Compare bem with exact spheres, and rays and kirchhoff with bem."""
    scenes = bodies()
    rows = []
    for name in arguments.bodies or scenes:
        judge = "spheres" if name == "spheres" else "bem"
        truth = _heard(scenes[name], judge, arguments.poses)
        for engine in ("bem", "kirchhoff", "rays", "hybrid"):
            if engine != judge:
                found = _heard(scenes[name], engine, arguments.poses)
                rows += _compared(name, engine, found, judge, truth)
    return {"poses": arguments.poses, "solved_up_to_hz": SOLVED, "rows": rows}


def _heard(scene: Any, engine: str, poses: int) -> dict[str, Any]:
    """Return spectrograms in dB (P, E, R, F), their frequencies, and what they cost."""
    from sononerf.geometry.poses import Poses
    from sononerf.run.build import simulator_of
    from sononerf.settings.loading import validate_settings
    from sononerf.simulation.solved import Solved

    data: dict[str, Any] = {"scene": {"name": "sphere"}, "spectrogram": ANALYSIS}
    data["simulation"] = {"engine": engine}
    if engine in ("spheres", "bem"):
        data["simulation"]["frequency_max"] = SOLVED
    started = time.perf_counter()
    simulator = simulator_of(scene, validate_settings(data, "benchmark wave"))
    generator = np.random.default_rng(0)
    places = Poses.sphere(poses, radius=DISTANCE, aim_jitter=0.0, generator=generator)
    solver = simulator.engine
    solver.prepare(places.positions, places.rotations)
    levels = []
    for seed, pose in enumerate(zip(places.positions, places.rotations, strict=True)):
        echo = simulator.echo(*pose, seed=seed)
        if not isinstance(solver, Solved):
            echo = _same_band(echo, simulator.head.analysis.sampling_rate)
        magnitude = simulator.head.receive(echo, seed=seed)[1]
        levels.append(20.0 * np.log10(np.maximum(magnitude, 1e-12)))
    found = {"level": np.stack(levels), "frequency": simulator.head.frequency}
    found["seconds"] = time.perf_counter() - started
    found["unknowns"] = getattr(solver, "unknowns", None)
    found["frequencies"] = len(getattr(solver, "frequency", ()))
    return found


def _same_band(echo: NDArray[np.float64], rate: float) -> NDArray[np.float64]:
    """Let an echo fall to zero as the solved ones do: else what lies above would leak below."""
    from sononerf.simulation.solved import TAPER

    whole = SOLVED / TAPER
    frequency = np.fft.rfftfreq(2 * echo.shape[-1], 1.0 / rate)
    fall = np.clip((frequency - whole) / (SOLVED - whole), 0.0, 1.0)
    spectrum = np.fft.rfft(echo, 2 * echo.shape[-1]) * 0.5 * (1.0 + np.cos(np.pi * fall))
    return np.fft.irfft(spectrum)[..., : echo.shape[-1]]


def _compared(
    name: str, engine: str, found: dict[str, Any], judge: str, truth: dict[str, Any]
) -> list[dict[str, Any]]:
    rows = []
    level, frequency = truth["level"], truth["frequency"]
    loudest = level.max(axis=(1, 2, 3), keepdims=True)
    for (low, high), within in ((band, within) for band in BANDS for within in (10.0, 20.0, 30.0)):
        heard = (level > loudest - within) & (frequency >= low) & (frequency <= high)
        error = (found["level"] - level)[heard]
        row: dict[str, Any] = {"body": name, "engine": engine, "judge": judge}
        row |= {"low_hz": low, "high_hz": high, "within_db": within}
        row |= {"cells": int(heard.sum()), "mean_db": float(np.abs(error).mean())}
        row |= {"median_db": float(np.median(np.abs(error))), "bias_db": float(error.mean())}
        row |= {"seconds": found["seconds"], "judge_seconds": truth["seconds"]}
        row |= {"judge_unknowns": truth["unknowns"], "judge_frequencies": truth["frequencies"]}
        rows.append(row)
    return rows
