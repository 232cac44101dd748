# SPDX-License-Identifier: MIT
"""What the simulator costs, and how much its random rays leave to chance."""

from __future__ import annotations

import argparse
import resource
import statistics
import sys
import time
from typing import Any

import numpy as np
from numpy.typing import NDArray

from sononerf.head.decibels import compress, mae_db
from sononerf.run.build import simulator_of
from sononerf.scene.scene import load_scene
from sononerf.settings.loading import load_settings, validate_settings
from sononerf.settings.schema import Settings
from sononerf.simulation.simulator import ensemble_poses, pose_seed

REFERENCE_RATIO = 1e-3  # the reported decibels start 60 dB below the greatest magnitude


class Recorder:
    """Keeps what the ray caster asks of Embree, to ask it again without anything else."""

    def __init__(self, engine: Any) -> None:
        self.engine = engine
        self.asked: list[tuple[str, tuple[NDArray[np.float32], ...]]] = []

    def first(self, origins: NDArray[np.float64], directions: NDArray[np.float64]) -> Any:
        """Pass on, and keep."""
        given = origins.astype(np.float32), directions.astype(np.float32)
        self.asked.append(("INTERSECT", given))
        return self.engine.first(origins, directions)

    def blocked(self, origins: NDArray[np.float64], spans: NDArray[np.float64]) -> Any:
        """Pass on, and keep."""
        given = origins.astype(np.float32), spans.astype(np.float32)
        self.asked.append(("OCCLUDED", given))
        return self.engine.blocked(origins, spans)

    def replay(self) -> tuple[float, int]:
        """Return the seconds that the same rays take, and how many they are."""
        scene, total = self.engine._scene, 0
        start = time.perf_counter()
        for query, (origins, directions) in self.asked:
            extra = {"dists": np.ones(len(origins), np.float32)} if query == "OCCLUDED" else {}
            scene.run(origins, directions, query=query, **extra)
            total += len(origins)
        return time.perf_counter() - start, total


def settings_for(arguments: argparse.Namespace, **simulation: Any) -> Settings:
    """Return the defaults, but for what was asked for."""
    simulation = {"bounces": arguments.bounces, **simulation}
    plain = {"scene": {"name": arguments.scene}, "simulation": simulation}
    return validate_settings(plain, "benchmark")


def simulate(arguments: argparse.Namespace) -> dict[str, Any]:
    """Time the simulator against Embree alone, pose by pose in turn."""
    settings = settings_for(arguments, rays=arguments.rays)
    scene = load_scene(arguments.scene)
    simulator = simulator_of(scene, settings)
    poses, _ = ensemble_poses(settings.poses)
    # Of the default engine's two halves the one that traces.
    tracer = getattr(simulator.engine, "high", simulator.engine)
    recorder = Recorder(tracer.caster._engine)
    whole, bare, rays = [], [], []
    count = min(arguments.poses, len(poses))
    start = time.perf_counter()
    simulator.engine.prepare(poses.positions[:count], poses.rotations[:count])
    solved = time.perf_counter() - start
    for index in range(-1, count):
        number = max(index, 0)
        pose = poses.positions[number], poses.rotations[number]
        seed = pose_seed(0, number)
        start = time.perf_counter()
        simulator.spectrogram(*pose, seed=seed)
        seconds = time.perf_counter() - start
        tracer.caster._engine = recorder
        recorder.asked.clear()
        simulator.spectrogram(*pose, seed=seed)
        tracer.caster._engine = recorder.engine
        alone, cast = recorder.replay()
        if index >= 0:  # the first call of all builds tables
            whole.append(seconds)
            bare.append(alone)
            rays.append(cast)
        print(f"\r{index + 1} of {arguments.poses}", end="", file=sys.stderr, flush=True)
    print(file=sys.stderr)
    return {
        "scene": arguments.scene,
        "triangles": len(scene.mesh.faces),
        "rays": arguments.rays,
        "bounces": arguments.bounces,
        "poses": len(whole),
        "solved_s": solved,
        "total_s": solved + sum(whole),
        "embree_s": sum(bare),
        "ratio": (solved + sum(whole)) / sum(bare),
        "pose_median_s": statistics.median(whole),
        "embree_rays_per_pose": sum(rays) / len(rays),
        "peak_memory_bytes": resource.getrusage(resource.RUSAGE_SELF).ru_maxrss * 1024,
    }


def noise(arguments: argparse.Namespace) -> dict[str, Any]:
    """Compare simulations of the test poses that differ in their rays alone."""
    scene = load_scene(arguments.scene)
    rays = arguments.rays
    default = settings_for(arguments, rays=rays)
    poses, split = ensemble_poses(default.poses)
    chosen = np.flatnonzero(split == 2)[: arguments.poses]

    def spectrograms(count: int, seed: int) -> NDArray[np.float64]:
        simulator = simulator_of(scene, settings_for(arguments, rays=count))
        simulator.engine.prepare(poses.positions[chosen], poses.rotations[chosen])
        return np.stack(
            [
                simulator.spectrogram(
                    poses.positions[i], poses.rotations[i], seed=pose_seed(seed, int(i))
                )
                for i in chosen
            ]
        )

    first = spectrograms(rays, 0)
    reference = REFERENCE_RATIO * float(first.max())
    level = compress(first, reference)
    found: dict[str, Any] = {"scene": arguments.scene, "rays": rays, "poses": len(chosen)}
    for name, count, seed in (
        ("other_seed", rays, 1),
        ("twice_the_rays", 2 * rays, 2),
        ("16_times_the_rays", 16 * rays, 3),
    ):
        other = compress(spectrograms(count, seed), reference)
        active = (level >= 3.0) | (other >= 3.0)
        found[name] = {
            "mae_db": mae_db(level, other),
            "mae_db_active": mae_db(level, other, active=True),
            "mean_level_db_active": float((other - level)[active].mean()),
        }
        print(name, found[name], file=sys.stderr, flush=True)
    return found


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
