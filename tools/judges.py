# SPDX-License-Identifier: MIT
"""Echoes of the engines that are slow and exact, as fixtures of the tests.

``python tools/judges.py tests/simulation/judges.npz`` writes impulse responses at the ears, cut to
where they are not zero: ``CASE/echo`` (P, E, S) float32, ``CASE/start`` (P, E), the sample of the
record at which each begins, ``CASE/position`` and ``CASE/rotation``.
"""

from __future__ import annotations

import sys
import time
from pathlib import Path
from typing import Any

import numpy as np
import trimesh

from sononerf.geometry.poses import Poses, look_at
from sononerf.head.head import Head
from sononerf.run.build import simulator_of
from sononerf.scene.material import RIGID
from sononerf.scene.scene import Scene, load_scene
from sononerf.settings.loading import validate_settings
from sononerf.simulation.reference.kirchhoff import Kirchhoff
from sononerf.simulation.simulator import ensemble_poses
from tests.simulation import listening
from tests.simulation import test_diffraction as edges
from tests.simulation import test_shadows as shadows
from tests.simulation import test_support as support
from tests.simulation.listening import ball
from tools.benchmarks import wave

Places = tuple[Any, Any]


def settings_of(engine: str, frequency_max: float | None = None, **sections: Any) -> Any:
    simulation = {"engine": engine, "frequency_max": frequency_max}
    data = {"scene": {"name": "sphere"}, "simulation": simulation, **sections}
    return validate_settings(data, "judges")


def solved(scene: Scene, settings: Any, places: Places) -> tuple[Any, ...]:
    simulator = simulator_of(scene, settings)
    simulator.engine.prepare(*places)
    return *places, [simulator.echo(*pose, seed=0) for pose in zip(*places, strict=True)]


def looking(positions: Any) -> Places:
    positions = np.asarray(positions, dtype=float)
    return positions, np.stack([look_at(place, np.zeros(3)) for place in positions])


def three_spheres() -> tuple[Any, ...]:
    """The scene of that name, with the settings of ``tools/benchmark.py exact``."""
    analysis = {"frequency_max": 80e3}
    settings = settings_of("spheres", None, spectrogram=analysis, poses={"count": 100})
    poses, split = ensemble_poses(settings.poses)
    chosen = np.flatnonzero(split == 2)[:12]
    places = poses.positions[chosen], poses.rotations[chosen]
    return solved(load_scene("three_spheres"), settings, places)


def small(name: str, engine: str) -> tuple[Any, ...]:
    """Bodies of some centimetres: three balls, a leaf, an open beaker."""
    settings = settings_of(engine, wave.SOLVED, spectrogram=wave.ANALYSIS)
    generator = np.random.default_rng(0)
    poses = Poses.sphere(8, radius=wave.DISTANCE, aim_jitter=0.0, generator=generator)
    return solved(wave.bodies()[name], settings, (poses.positions, poses.rotations))


def half_hidden() -> tuple[Any, ...]:
    """A ball half behind another."""
    pair = trimesh.util.concatenate([ball(0.012), ball(0.012, (-0.04, 0.006, 0.0))])
    return solved(Scene(pair), settings_of("spheres", 60e3), looking([[0.35, 0.05, -0.02]]))


def shaded(offset: float, alone: bool) -> tuple[Any, ...]:
    """A ball of 15 mm behind another, moved aside; or the one behind alone."""
    front, behind = shadows.both(offset)
    mesh = behind if alone else trimesh.util.concatenate([front, behind])
    places = np.zeros((1, 3)), np.eye(3)[None]
    return solved(Scene(mesh, RIGID), settings_of("spheres", 100e3), places)


def supported(table: bool) -> tuple[Any, ...]:
    """A ball over a rigid plane; or that ball and its image."""
    mesh = support.BALL if table else trimesh.util.concatenate([support.BALL, support.BELOW])
    head = Head(support.MICROPHONE, support=support.TABLE if table else None)
    from sononerf.settings.schema import SimulationSettings
    from sononerf.simulation.simulator import Simulator

    options = SimulationSettings(engine="spheres", frequency_max=60e3)
    simulator = Simulator.of(Scene(mesh), head, options)
    places = support.POSES, support.TURNS
    simulator.engine.prepare(*places)
    return *places, [simulator.echo(*pose, seed=0) for pose in zip(*places, strict=True)]


def cube() -> tuple[Any, ...]:
    """A cube by physical optics, beside its faces' normals and near them; heads without pattern."""
    angles = np.radians([0.0, 4.0, 6.0])
    near = [0.3 * np.array([np.cos(a), 0.8 * np.sin(a), 0.6 * np.sin(a)]) for a in angles]
    off = [0.3 * np.array(d) for d in edges.off_normal(8).round(3).tolist()]
    engine = Kirchhoff(Scene(edges.CUBE, RIGID), listening.hearing(), frequency_max=110e3)
    places = np.array(off + near), np.stack([np.eye(3)] * 11)
    return *places, [engine.echo(*pose, seed=0) for pose in zip(*places, strict=True)]


def glints(name: str, options: dict[str, Any]) -> tuple[Any, ...]:
    """Glints by physical optics, with the default head."""
    places = looking([[0.35, 0.05, 0.02]])
    return solved(load_scene(name, options), settings_of("kirchhoff"), places)


CASES = {
    "three_spheres": three_spheres,
    "balls": lambda: small("spheres", "spheres"),
    "half_hidden": half_hidden,
    **{f"shaded_{1e3 * o:g}": lambda o=o: shaded(o, False) for o in (0.012, 0.018, 0.03)},
    **{f"shaded_{1e3 * o:g}_alone": lambda o=o: shaded(o, True) for o in (0.012, 0.018, 0.03)},
    "on_table": lambda: supported(True),
    "over_image": lambda: supported(False),
    "cube_kirchhoff": cube,
    "sphere_kirchhoff": lambda: glints("sphere", {"radius": 0.0286}),
    "three_spheres_kirchhoff": lambda: glints("three_spheres", {}),
    "leaf": lambda: small("leaf", "bem"),
    "beaker": lambda: small("beaker", "bem"),
}


def packed(positions: Any, rotations: Any, echoes: Any) -> dict[str, Any]:
    echoes = np.asarray(echoes)
    loud = np.abs(echoes) > 1e-6 * np.abs(echoes).max(axis=(1, 2), keepdims=True)
    start = loud.argmax(axis=2)
    last = echoes.shape[2] - loud[..., ::-1].argmax(axis=2)
    longest = int((last - start).max())
    kept = np.zeros((*start.shape, longest), dtype=np.float32)
    for index in np.ndindex(start.shape):
        part = echoes[index][start[index] : start[index] + longest]
        kept[index][: len(part)] = part
    return {"echo": kept, "start": start, "position": positions, "rotation": rotations}


def main(output: Path) -> None:
    made: dict[str, Any] = {}
    for name, case in CASES.items():
        started = time.perf_counter()
        made |= {f"{name}/{key}": value for key, value in packed(*case()).items()}
        size = made[f"{name}/echo"].nbytes
        print(f"{name}: {time.perf_counter() - started:.0f} s, {size} bytes", flush=True)
        np.savez_compressed(output, **made)


if __name__ == "__main__":
    main(Path(sys.argv[1]))
