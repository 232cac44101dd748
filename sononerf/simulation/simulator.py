# SPDX-License-Identifier: MIT
"""The echo simulator: from a scene, a head and poses to the sound at the receivers."""

from __future__ import annotations

import logging
import math
from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import trimesh
from numpy.typing import NDArray

from sononerf.array_types import Floats, Singles
from sononerf.echoes.splits import TEST, TRAIN, VALIDATION
from sononerf.errors import InputError, SettingsError
from sononerf.geometry.poses import (
    Poses,
    cap_poses,
    cylinder_poses,
    random_cylinder_poses,
    random_poses,
    random_sphere_poses,
)
from sononerf.head.head import Head
from sononerf.head.row_filters import row_widths
from sononerf.memory import require_memory
from sononerf.progress import Progress
from sononerf.scene.scene import Scene
from sononerf.settings.scene_schema import PoseSettings
from sononerf.settings.schema import SimulationSettings, SpectrogramSettings
from sononerf.simulation.audibility import RESOLVED_FREQUENCY, silence_before
from sononerf.simulation.engine import Engine
from sononerf.simulation.hearing import hearing_of
from sononerf.simulation.hybrid import Hybrid, hybrid
from sononerf.simulation.rays import Rays
from sononerf.simulation.reference.kirchhoff import Kirchhoff
from sononerf.simulation.solved import TAPER, Solved

logger = logging.getLogger("sononerf")

COARSE = 1.25
"""Times ``RESOLVED_FREQUENCY``: bands that end above are warned of. The default band ends there."""
UNSETTLED = 100_000
"""Rays per pose where neither a number is set nor an accuracy was measured, as in a preview."""
VERSION = 5  # to be raised when the same settings give other echoes: stores are told apart by it


class Simulator:
    """Simulator of what the receivers of a pose hear of a scene.

    Attributes:
        head: The head.
    """

    def __init__(self, engine: Engine) -> None:
        self.engine = engine
        self.head = engine.hearing.head

    @classmethod
    def of(cls, scene: Scene, head: Head, options: SimulationSettings) -> Simulator:
        """Return the simulator of a scene and a head.

        Args:
            head: The head. Of a scene on its support the part above it is ensonified together
                with its image: a rigid plane is exactly that.
        """
        hearing, analysis = hearing_of(head), head.analysis
        if head.plane is not None:
            if options.engine == "kirchhoff":
                raise SettingsError(
                    "simulation.engine=kirchhoff knows no support; set simulation.engine=rays"
                )
            scene = scene.with_image(head.plane)
        if options.engine in ("spheres", "bem"):
            return cls(
                _solver(options.engine)(
                    scene, hearing, frequency_max=solved_frequency(options, analysis)
                )
            )
        if options.engine == "kirchhoff":
            if any(material.lobe_width is not None for material in scene.materials):
                logger.warning(
                    "simulation.engine=kirchhoff takes surfaces as smooth; the material's lobes "
                    "are left out, simulation.engine=rays has them"
                )
            return cls(Kirchhoff(scene, hearing, frequency_max=1.1 * analysis.frequency_max))
        if analysis.frequency_max > COARSE * RESOLVED_FREQUENCY:
            logger.warning(
                "spectrogram.frequency_max=%g Hz: simulation.engine=%s resolves edges and shadows "
                "up to %g Hz; echoes of edges above it are less exact",
                *(analysis.frequency_max, options.engine, RESOLVED_FREQUENCY),
            )
        rays: dict[str, Any] = {
            "rays": options.rays or UNSETTLED,
            "bounces": options.bounces,
            "diffraction_points": options.diffraction_points,
        }
        if options.engine == "rays":
            return cls(Rays(scene, hearing, **rays))
        lowest, most = analysis.frequency_min, options.sources
        return cls(hybrid(scene, hearing, sources=most, frequency_min=lowest, **rays))

    @classmethod
    def of_surface(
        cls, mesh: trimesh.Trimesh, head: Head, options: SimulationSettings, *, rays: int
    ) -> Simulator:
        """Return the hybrid engine on a reconstructed surface, without noise."""
        wanted = options.model_copy(update={"engine": "hybrid", "rays": rays})
        return cls.of(Scene(mesh, warns=False), head.without_noise(), wanted)

    def keep_equations(self) -> None:
        """Keep factorised equations in memory, so that single poses are solved for at once."""
        if isinstance(self.engine, Hybrid):
            self.engine.low.keeps = True

    def prepare(
        self,
        positions: Floats,
        rotations: Floats,
        progress: Progress,
    ) -> None:
        """Let the engine do its work for all poses at once, and show how far it is.

        Args:
            positions ((P, 3), m): Places of the head, world frame.
            rotations (P, 3, 3): Head to world.
        """
        if len(positions) and self.engine.parts:
            with progress.task("solving", self.engine.parts) as task:
                self.engine.prepare(positions, rotations, lambda *_: task.advance())

    def hits(self, position: Floats, rotation: Floats, *, seed: int) -> tuple[Floats, Floats]:
        """Places (N, 3) that send sound straight back, m, and how much (N,), dB below the most."""
        points, strength = self.engine.hits(position, rotation, seed=seed)
        loudest = max(float(strength.max(initial=0.0)), 1e-300)
        return points, 20.0 * np.log10(np.maximum(strength / loudest, 1e-10))

    def echo(self, position: Floats, rotation: Floats, *, seed: int) -> Floats:
        """Pressure at both ears for an impulse; see :meth:`Engine.echo`.

        Engines that solve the wave equation hear with the head as it is; those of other engines are
        silent before sound can arrive, see :func:`silence_before`.
        """
        engine = self.engine
        echo = engine.echo(position, rotation, seed=seed)
        if isinstance(engine, Solved):
            return echo
        emitter, ears = engine.hearing.places(position, rotation)
        first = engine.arrival.shortest(emitter[None], ears[None])[0] / self.head.speed_of_sound
        rate = engine.hearing.synthesis.sampling_rate
        return silence_before(echo, first, sampling_rate=rate)

    def spectrogram(self, position: Floats, rotation: Floats, *, seed: int) -> Singles:
        """Return the magnitude at both ears, over range and frequency.

        Position, rotation and seed are those of :meth:`Engine.echo`.

        Returns:
            magnitude ((E, R, F) float32): Linear.
        """
        return self.receive(position, rotation, seed=seed)[1].astype(np.float32)

    def receive(self, position: Floats, rotation: Floats, *, seed: int) -> tuple[Floats, Floats]:
        """Return the sound at both ears for the call, noise included, and its spectrogram.

        Position, rotation and seed are those of :meth:`Engine.echo`.

        Returns:
            waveform (E, S): Pressure from the start of the emission on.
            magnitude (E, R, F): Linear; dechirped where the call is a sweep.
        """
        echo = self.echo(position, rotation, seed=seed)
        return self.head.receive(echo, seed=seed)


def pose_seed(seed: int, index: int) -> int:
    """Seed of one pose of an ensemble; who simulates it, and when, does not matter."""
    state = np.random.SeedSequence([seed, index]).generate_state(1, np.uint64)
    return int(state[0])


def _solver(engine: str) -> type[Solved]:
    if engine == "spheres":
        from sononerf.simulation.reference.spheres import Spheres

        return Spheres
    from sononerf.simulation.reference.boundary import Boundary  # imports torch: seconds

    return Boundary


def solved_frequency(wanted: SimulationSettings, analysis: SpectrogramSettings) -> float:
    """Return the frequency (Hz) at which the solved response has fallen to zero.

    Where it is not set, the response is whole up to the highest analysed frequency and the
    bandwidth (-6 dB) of a row there above it.
    """
    if wanted.frequency_max is None:
        bandwidth = float(row_widths(analysis, analysis.frequency_max)[1])
        return min(TAPER * (analysis.frequency_max + bandwidth), analysis.sampling_rate / 2.0)
    whole = wanted.frequency_max / TAPER
    if whole < analysis.frequency_max:
        logger.warning(
            "simulation.frequency_max=%g Hz: what is heard fades from %.0f Hz on, below "
            "spectrogram.frequency_max (%g Hz)",
            *(wanted.frequency_max, whole, analysis.frequency_max),
        )
    return wanted.frequency_max


POSE_BYTES = 550
"""Memory per pose while poses are drawn, bytes; 510 to 530 were measured."""


def ensemble_poses(wanted: PoseSettings) -> tuple[Poses, NDArray[np.int8]]:
    """Return the poses of an experiment: first training, then validation, then test poses.

    Each set draws from a generator of its own, so that the number of one does not move another.
    The poses of a path stay in the order of its table.

    Returns:
        split ((P,) int8): 0 train, 1 validation, 2 test.
    """
    if wanted.path is not None:
        return _path_poses(wanted, wanted.path)
    number = wanted.count + wanted.validation + wanted.heldout
    require_memory(POSE_BYTES * number, f"drawing {number:,} poses", "lower poses.count")
    train, test = _arrangement(wanted)
    sets = (
        (TRAIN, wanted.count, train),
        (VALIDATION, wanted.validation, test),
        (TEST, wanted.heldout, test),
    )
    made, split = [], []
    for member, count, draw in sets:
        jitter = math.radians(wanted.aim_jitter_deg)
        made.append(draw(count, aim_jitter=jitter, generator=_generator(wanted, member)))
        split.append(np.full(count, member, dtype=np.int8))
    positions = np.concatenate([poses.positions for poses in made])
    rotations = np.concatenate([poses.rotations for poses in made])
    return Poses(positions, rotations), np.concatenate(split)


def _generator(wanted: PoseSettings, member: int) -> np.random.Generator:
    return np.random.default_rng(np.random.SeedSequence([wanted.seed, member]))


def _arrangement(wanted: PoseSettings) -> tuple[Callable[..., Poses], Callable[..., Poses]]:
    """Return the training poses, and functions that draw those for validation and test."""
    radius, axis = wanted.radius, wanted.axis
    if wanted.arrangement == "sphere":
        return partial(Poses.sphere, radius=radius), partial(random_sphere_poses, radius=radius)
    if wanted.heights is not None:
        where: dict[str, Any] = {"radius": radius, "heights": wanted.heights}
        return partial(cylinder_poses, **where), partial(random_cylinder_poses, **where)
    angle = math.pi if wanted.half_angle_deg is None else math.radians(wanted.half_angle_deg)
    distances = radius, wanted.radius_max or radius
    draw = partial(random_poses, radius=distances, axis=axis, half_angle=angle)
    if wanted.arrangement == "volume":
        return draw, draw
    return partial(cap_poses, radius=radius, axis=axis, half_angle=angle), draw


def _path_poses(wanted: PoseSettings, path: Path) -> tuple[Poses, NDArray[np.int8]]:
    """Read a flight path; its rows for validation and test are drawn at random."""
    poses = Poses.read(path)
    if len(poses) <= wanted.validation + wanted.heldout:
        raise InputError(
            f"{path}: {len(poses)} poses, of which poses.validation takes {wanted.validation} and "
            f"poses.heldout {wanted.heldout}; none is left to train on"
        )
    split = np.full(len(poses), TRAIN, dtype=np.int8)
    for member, count in ((TEST, wanted.heldout), (VALIDATION, wanted.validation)):
        order = _generator(wanted, member).permutation(len(poses))
        split[order[split[order] == TRAIN][:count]] = member
    return poses, split
