#!/usr/bin/env python3
# SPDX-License-Identifier: MIT
"""Measure what sononerf costs, as ratios within one run.

    python tools/benchmark.py simulate [--scene ua] [--rays 300000] [--poses 400]
    python tools/benchmark.py noise [--scene ua] [--poses 20]
    python tools/benchmark.py physics
    python tools/benchmark.py dechirp

``simulate``: seconds per pose, against those that embreex alone needs for the same rays, those for
visibility included, and the greatest memory. ``noise``: by how much two simulations differ that
have other rays, 16 times as many, or twice as many; with the reported decibels, on active cells.
``physics``: both engines against exact solutions. ``dechirp``: where and how long a point echo is
in the rows of a dechirped sweep.
"""

from __future__ import annotations

import argparse
import itertools
import json
import resource
import statistics
import sys
import time
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from sononerf.acoustics.spectrogram import compress
from sononerf.config import Settings, validate_settings
from sononerf.reconstruction.prediction import mae_db
from sononerf.scene import load_scene
from sononerf.simulation.ensemble import ensemble_poses, pose_seed
from sononerf.simulation.simulator import Simulator

sys.path.insert(0, str(Path(__file__).resolve().parent.parent))  # exact solutions are tests'
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
    simulator = Simulator.from_settings(scene, settings)
    poses, _ = ensemble_poses(settings)
    recorder = Recorder(simulator.engine.caster._engine)
    whole, bare, rays = [], [], []
    for index in range(-1, min(arguments.poses, len(poses))):
        number = max(index, 0)
        pose = poses.positions[number], poses.rotations[number]
        seed = pose_seed(0, number)
        start = time.perf_counter()
        simulator.spectrogram(*pose, seed=seed)
        seconds = time.perf_counter() - start
        simulator.engine.caster._engine = recorder
        recorder.asked.clear()
        simulator.spectrogram(*pose, seed=seed)
        simulator.engine.caster._engine = recorder.engine
        alone, count = recorder.replay()
        if index >= 0:  # the first call of all builds tables
            whole.append(seconds)
            bare.append(alone)
            rays.append(count)
        print(f"\r{index + 1} of {arguments.poses}", end="", file=sys.stderr, flush=True)
    print(file=sys.stderr)
    return {
        "scene": arguments.scene,
        "triangles": len(scene.mesh.faces),
        "rays": arguments.rays,
        "bounces": arguments.bounces,
        "poses": len(whole),
        "total_s": sum(whole),
        "embree_s": sum(bare),
        "ratio": sum(whole) / sum(bare),
        "pose_median_s": statistics.median(whole),
        "embree_rays_per_pose": sum(rays) / len(rays),
        "peak_memory_bytes": resource.getrusage(resource.RUSAGE_SELF).ru_maxrss * 1024,
    }


def noise(arguments: argparse.Namespace) -> dict[str, Any]:
    """Compare simulations of the test poses that differ in their rays alone."""
    scene = load_scene(arguments.scene)
    default = settings_for(arguments)
    rays = default.simulation.rays
    poses, split = ensemble_poses(default)
    chosen = np.flatnonzero(split == 2)[: arguments.poses]

    def spectrograms(count: int, seed: int) -> NDArray[np.float64]:
        simulator = Simulator.from_settings(scene, settings_for(arguments, rays=count))
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


def physics(_: argparse.Namespace) -> dict[str, Any]:
    """Compare the engines with a sphere's partial waves, and with each other."""
    from sononerf.geometry.poses import look_at
    from sononerf.material import RIGID
    from sononerf.scene import Scene
    from sononerf.simulation.kirchhoff import Kirchhoff
    from tests.simulation.exact import rigid_sphere
    from tests.simulation.listening import ball, delay, echoes, hearing, level_db, rays, spectrum
    from tests.simulation.listening import wall as wall_at

    def heard(engine: Any, distance: float, band: NDArray[np.float64], until: float) -> Any:
        position = np.array([distance, 0.0, 0.0])
        (echo,) = echoes(engine, position, look_at(position, np.zeros(3)))
        return spectrum(echo, band, until=until)

    found: dict[str, Any] = {"kirchhoff_against_partial_waves": [], "rays_against_kirchhoff": []}
    everywhere = hearing()
    band = np.linspace(10e3, 100e3, 181)
    for radius, distance in itertools.product((0.015, 0.0286), (0.3, 0.45)):
        scene = Scene(ball(radius), RIGID)
        engine = Kirchhoff(scene, everywhere, frequency_max=110e3)
        exact = rigid_sphere(band, radius, distance, distance)
        error = level_db(heard(engine, distance, band, np.inf)) - level_db(exact)
        row: dict[str, Any] = {"radius_m": radius, "distance_m": distance}
        ka = 2.0 * np.pi * band * radius / 343.0
        for name, low, high in (("ka_5_to_12", 5, 12), ("ka_12_to_50", 12, 50)):
            part = error[(ka >= low) & (ka < high)]
            row[f"{name}_rms_db"] = float(np.sqrt(np.mean(part**2)))
            row[f"{name}_worst_db"] = float(np.abs(part).max())
        found["kirchhoff_against_partial_waves"].append(row)
    band = np.linspace(20e3, 100e3, 161)
    shapes = [("sphere", ball(radius), radius) for radius in (0.015, 0.0286)]
    shapes.append(("plate", wall_at(0.0, (-0.21, -0.2), (0.19, 0.22)), 0.0))
    for (name, mesh, radius), distance in itertools.product(shapes, (0.3, 0.45)):
        nearest = distance - radius
        # The specular echo alone: what comes from the rims, or creeps round, is later.
        until = nearest + (0.006 if radius == 0.0 else 0.012)
        levels, delays = [], []
        scene = Scene(mesh, RIGID)
        for engine in (
            rays(mesh, RIGID, everywhere, rays=100_000),
            Kirchhoff(scene, everywhere, frequency_max=110e3),
        ):
            pressure = heard(engine, distance, band, until)
            levels.append(level_db(pressure))
            turned = pressure * np.exp(4j * np.pi * band / 343.0 * nearest)
            delays.append(float(delay(turned, band)))
        found["rays_against_kirchhoff"].append(
            {
                "shape": name,
                "radius_m": radius,
                "distance_m": distance,
                "worst_db": float(np.abs(levels[0] - levels[1]).max()),
                "delay_error_mm": 1e3 * delays[0],
                "kirchhoff_delay_error_mm": 1e3 * delays[1],
            }
        )
    return found


def dechirp(_: argparse.Namespace) -> dict[str, Any]:
    """Measure a point echo's rows under sweeps of several lengths, as the tests do."""
    from sononerf.acoustics.reception import best_window, row_duration
    from sononerf.config import CallSettings
    from tests.acoustics.test_reception import ANALYSIS, HOP, analysis, measured

    rows = []
    for kind, length in itertools.product(("linear", "hyperbolic"), (0.2e-3, 1e-3, 3e-3)):
        call = CallSettings(kind=kind, duration=length)
        for window in (64, best_window(call, ANALYSIS)):
            offset, duration, frequency = measured(call, window)
            allowed = row_duration(call, analysis(window=window), frequency)
            rows.append(
                {
                    "kind": kind,
                    "duration_s": length,
                    "window": window,
                    "best": window != 64,
                    "worst_offset_hops": float(np.abs(offset).max() / HOP),
                    "worst_ratio_of_duration": float((duration / allowed).max()),
                }
            )
    return {"hop_s": HOP, "sweeps": rows}


def main() -> None:
    """Measure what the command line asks for."""
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    commands = parser.add_subparsers(dest="command", required=True)
    for run, poses in ((simulate, 400), (noise, 20), (physics, None), (dechirp, None)):
        command = commands.add_parser(run.__name__, help=(run.__doc__ or "").strip())
        command.set_defaults(run=run)
        if poses is not None:
            command.add_argument("--scene", default="ua")
            command.add_argument("--poses", type=int, default=poses)
            command.add_argument("--bounces", type=int, default=3)
        if run is simulate:
            command.add_argument("--rays", type=int, default=300_000)
    arguments = parser.parse_args()
    print(json.dumps(arguments.run(arguments), indent=2))


if __name__ == "__main__":
    main()
