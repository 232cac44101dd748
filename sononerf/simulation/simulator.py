# SPDX-License-Identifier: MIT
"""The echo simulator: from a scene, a head and poses to spectrograms."""

from __future__ import annotations

import copy
import logging
import math
from collections.abc import Callable, Generator
from contextlib import closing
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import trimesh
from numpy.typing import NDArray

from sononerf.echoes.memory_ensemble import TEST, TRAIN, VALIDATION
from sononerf.errors import InputError, SonoNerfError
from sononerf.geometry.poses import (
    Poses,
    cap_poses,
    cylinder_poses,
    random_cylinder_poses,
    random_poses,
    random_sphere_poses,
)
from sononerf.head.front_end import RANGE_DB, compress, mae_db
from sononerf.head.head import Head
from sononerf.numerics import Floats, Singles
from sononerf.progress import Progress, Task
from sononerf.resources import (
    TaskError,
    available_cores,
    computed,
    may_start_processes,
    preload,
    require_memory,
)
from sononerf.scene.scene import Scene
from sononerf.settings.schema import SimulationSettings
from sononerf.settings.sections import PoseSettings
from sononerf.simulation.hearing import RESOLVED_FREQUENCY, Arrival, hearing_of, silence_before
from sononerf.simulation.low_band import LowBand, low_band
from sononerf.simulation.rays import Rays

logger = logging.getLogger("sononerf")

MAX_BAND_RATIO = 1.25
"""Times ``RESOLVED_FREQUENCY``: bands that end above are warned of. The default band ends there."""
DEFAULT_RAYS = 100_000
"""Rays per pose where neither a number is set nor an accuracy was measured, as in a preview."""
VERSION = 6  # to be raised when the same settings give other echoes: stores are told apart by it


class Simulator:
    """Simulator of what the receivers of a pose hear of a scene: rays, and a low band without.

    Attributes:
        head: The head.
        rays: The part that traces rays.
        low: The solution of the wave equation at low frequencies, where there is one.
        note: Text for the user: what simulates this scene, and why.
    """

    def __init__(self, scene: Scene, head: Head, options: SimulationSettings) -> None:
        """Prepare a scene for a head."""
        self.head, hearing, spectrogram = head, hearing_of(head), head.spectrogram
        if head.plane is not None:
            scene = scene.with_image(head.plane)
        if spectrogram.frequency_max > MAX_BAND_RATIO * RESOLVED_FREQUENCY:
            logger.warning(
                "spectrogram.frequency_max=%g Hz: simulation.engine=%s resolves edges and shadows "
                "up to %g Hz; echoes of edges above it are less exact",
                *(spectrogram.frequency_max, options.engine, RESOLVED_FREQUENCY),
            )
        self.scene, self.hearing, self.arrival = scene, hearing, Arrival(scene)
        self.low: LowBand | None = None
        self.note, band = "", None
        if options.engine == "hybrid":
            low = low_band(
                scene,
                hearing,
                self.arrival,
                sources=options.sources,
                frequency_min=spectrogram.frequency_min,
            )
            if isinstance(low, str):
                self.note = f"rays at all frequencies, because {low}"
            else:
                self.low, band = low, 1.0 - low.taper(hearing.synthesis.frequency)
                self.note = (
                    f"wave equation up to {low.frequency_full / 1e3:.0f} kHz with {low.most} "
                    f"sources, rays from {low.frequency_max / 1e3:.0f} kHz on"
                )
        self.rays = Rays(
            scene, hearing, rays=options.rays or DEFAULT_RAYS, bounces=options.bounces, band=band
        )

    @classmethod
    def of_surface(
        cls, mesh: trimesh.Trimesh, head: Head, options: SimulationSettings, *, rays: int
    ) -> Simulator:
        """Return the hybrid engine on a reconstructed surface, without noise."""
        chosen = options.model_copy(update={"engine": "hybrid", "rays": rays})
        return cls(Scene(mesh, warns=False), head.without_noise(), chosen)

    def keep_equations(self) -> None:
        """Keep factorised equations in memory, so that single poses are solved for at once."""
        if self.low is not None:
            self.low.keeps = True

    def prepare(self, positions: Floats, rotations: Floats, progress: Progress) -> None:
        """Solve for the low band of all poses at once, and show how far it is.

        In: positions ((P, 3), m), rotations (P, 3, 3).
        """
        if len(positions) and self.low is not None:
            with progress.task("solving", len(self.low.frequency)) as task:
                self.low.prepare(positions, rotations, task.advance)

    def hits(self, position: Floats, rotation: Floats) -> tuple[Floats, Floats]:
        """Places (N, 3) that send sound straight back, m, and how much (N,), dB below the most."""
        points, strength = self.rays.hits(position, rotation)
        loudest = max(float(strength.max(initial=0.0)), 1e-300)
        return points, 20.0 * np.log10(np.maximum(strength / loudest, 1e-10))

    def echo(self, position: Floats, rotation: Floats, *, seed: int) -> Floats:
        """Return the pressure at the ears (E, S) for a call that is one sample of height 1.

        It is silent before sound can arrive, see :func:`silence_before`.

        In: position ((3,), m), rotation (3, 3).
        """
        if not (np.isfinite(position).all() and np.isfinite(rotation).all()):
            raise ValueError("the pose is no finite number")
        echo = self.rays.echo(position, rotation, seed=seed)
        if self.low is not None:
            echo += self.low.echo(position, rotation)
        emitter, ears = self.hearing.places(position, rotation)
        first = self.arrival.shortest(emitter[None], ears[None])[0] / self.head.speed_of_sound
        rate = self.hearing.synthesis.sampling_rate
        return silence_before(echo, first, sampling_rate=rate)

    def spectrogram(self, position: Floats, rotation: Floats, *, seed: int) -> Singles:
        """Return the magnitude at both ears, over range and frequency.

        Out: magnitude ((E, R, F) float32).
        """
        return self.receive(position, rotation, seed=seed)[1].astype(np.float32)

    def receive(self, position: Floats, rotation: Floats, *, seed: int) -> tuple[Floats, Floats]:
        """Return the sound at both ears for the call, noise included, and its spectrogram.

        Out: waveform (E, S), magnitude (E, R, F).
        """
        echo = self.echo(position, rotation, seed=seed)
        return self.head.receive(echo, seed=seed)


def pose_seed(seed: int, index: int) -> int:
    """Seed of one pose of an ensemble; who simulates it, and when, does not matter."""
    state = np.random.SeedSequence([seed, index]).generate_state(1, np.uint64)
    return int(state[0])


POSE_BYTES = 550
"""Memory per pose while poses are drawn, bytes; 510 to 530 were measured."""


def ensemble_poses(settings: PoseSettings) -> tuple[Poses, NDArray[np.int8]]:
    """Return the poses of an experiment: first training, then validation, then test poses.

    Each set draws from a generator of its own, so that the number of one does not move another.
    The poses of a path stay in the order of its table.

    Out: split ((P,) int8).
    """
    if settings.path is not None:
        return _path_poses(settings, settings.path)
    number = settings.count + settings.validation + settings.heldout
    require_memory(POSE_BYTES * number, f"drawing {number:,} poses", "lower poses.count")
    train, test = _arrangement(settings)
    sets = (
        (TRAIN, settings.count, train),
        (VALIDATION, settings.validation, test),
        (TEST, settings.heldout, test),
    )
    made, split = [], []
    for member, count, draw in sets:
        jitter = math.radians(settings.aim_jitter_deg)
        made.append(draw(count, aim_jitter=jitter, generator=_generator(settings, member)))
        split.append(np.full(count, member, dtype=np.int8))
    positions = np.concatenate([poses.positions for poses in made])
    rotations = np.concatenate([poses.rotations for poses in made])
    return Poses(positions, rotations), np.concatenate(split)


def _generator(settings: PoseSettings, member: int) -> np.random.Generator:
    return np.random.default_rng(np.random.SeedSequence([settings.seed, member]))


def _arrangement(settings: PoseSettings) -> tuple[Callable[..., Poses], Callable[..., Poses]]:
    """Return the training poses, and functions that draw those for validation and test."""
    radius, axis = settings.radius, settings.axis
    if settings.arrangement == "sphere":
        return partial(Poses.sphere, radius=radius), partial(random_sphere_poses, radius=radius)
    if settings.heights is not None:
        where: dict[str, Any] = {"radius": radius, "heights": settings.heights}
        return partial(cylinder_poses, **where), partial(random_cylinder_poses, **where)
    angle = math.pi if settings.half_angle_deg is None else math.radians(settings.half_angle_deg)
    distances = radius, settings.radius_max or radius
    draw = partial(random_poses, radius=distances, axis=axis, half_angle=angle)
    if settings.arrangement == "volume":
        return draw, draw
    return partial(cap_poses, radius=radius, axis=axis, half_angle=angle), draw


def _path_poses(settings: PoseSettings, path: Path) -> tuple[Poses, NDArray[np.int8]]:
    """Read a flight path; its rows for validation and test are drawn at random."""
    poses = Poses.read(path)
    if len(poses) <= settings.validation + settings.heldout:
        raise InputError(
            f"{path}: {len(poses)} poses, of which poses.validation takes "
            f"{settings.validation} and poses.heldout {settings.heldout}; none is left to train on"
        )
    split = np.full(len(poses), TRAIN, dtype=np.int8)
    for member, count in ((TEST, settings.heldout), (VALIDATION, settings.validation)):
        order = _generator(settings, member).permutation(len(poses))
        split[order[split[order] == TRAIN][:count]] = member
    return poses, split


MOST_WORKERS = 8
POSE_RAYS = 25_000
"""Rays that take as long as what a pose takes besides its rays."""
WORTH_RAYS = 1_000_000
"""Rays of all poses, with these, from which other processes save time: it takes them a second to
start."""

READY = "sononerf.simulation.ready"
"""What worker processes have imported when they start."""
preload(READY)

Results = Generator[tuple[int, Singles], None, None]
SeedOf = Callable[[int], int]
"""Gives the seed of a pose by its index."""


def useful_workers(poses: int, rays: int) -> int:
    """Return the number of processes that simulates the poses soonest; one means this process."""
    worth = poses * (rays + POSE_RAYS) >= WORTH_RAYS and may_start_processes()
    return min(available_cores(), MOST_WORKERS) if worth else 1


def simulated(
    simulator: Simulator,
    poses: Poses,
    indices: list[int],
    seed_of: SeedOf,
    *,
    workers: int | None = None,
    scheduler: str | None = None,
) -> Results:
    """Yield indices and spectrograms of poses, in any order."""
    if workers is None:
        workers = useful_workers(len(indices), simulator.rays.rays)
    workers = workers if may_start_processes() else 1
    if simulator.low is not None:
        simulator.low.prepare(poses.positions[indices], poses.rotations[indices])
    tasks = {i: (poses.positions[i], poses.rotations[i], seed_of(i)) for i in indices}
    try:
        if workers > 1 or scheduler is not None:
            yield from computed(_one, simulator, tasks, workers, scheduler=scheduler)
            return
        for index, task in tasks.items():
            try:
                spectrogram = _one(simulator, *task)
            except Exception as error:
                raise TaskError(index, error) from error
            yield index, spectrogram
    except TaskError as error:
        raise SonoNerfError(f"pose {error.number} cannot be simulated: {error}") from error


def _one(simulator: Simulator, position: Floats, rotation: Floats, seed: int) -> Singles:
    return simulator.spectrogram(position, rotation, seed=seed)


FIRST_RAYS = 10_000
"""Rays per pose of the first trial. Fewer rays hardly save time."""
MAX_RAYS = 300_000
"""Largest number of rays per pose that the search for an accuracy takes. Sound that bounces between
many bodies converges slowly: with this number ``ua`` has 0.25 dB."""
TRIAL_POSES = 8
"""Poses that are simulated twice in a trial, spread evenly over all of them."""
CONVERGENCE = 0.5
"""The difference is proportional to the number of rays to the power -CONVERGENCE, measured from
30,000 to 300,000 rays on ``ua``."""
LEAST_DB = 1e-6
"""Difference below which two simulations are the same, dB."""
RAYS_FACTOR = 1.3, 10.0
"""Least and greatest factor from one trial's number of rays to the next one's."""


def settle_rays(
    simulator: Simulator,
    poses: Poses,
    options: SimulationSettings,
    progress: Progress,
    *,
    workers: int | None = None,
) -> int:
    """Set the number of rays per pose that reaches the accuracy of the settings.

    The difference between two seeds is measured at a few poses, as the noise floor is: the mean
    over active cells of reported decibels. Call :meth:`Simulator.prepare` first; its results are
    used.
    """
    tracer = simulator.rays
    if options.rays is not None:
        tracer.rays = options.rays
        return tracer.rays
    chosen = np.unique(np.linspace(0, len(poses) - 1, TRIAL_POSES).round().astype(int))
    some = Poses(poses.positions[chosen], poses.rotations[chosen])
    tracer.rays = FIRST_RAYS
    trials: list[float] = []  # errors, scaled to one ray per pose
    while tracer.rays < MAX_RAYS:
        with progress.task(f"trying {tracer.rays} rays per pose", 2 * len(chosen)) as task:
            found = max(_difference(simulator, some, task, workers), LEAST_DB)
        trials.append(found * tracer.rays**CONVERGENCE)
        # A trial of so few poses is uncertain by a tenth or more, so all trials are averaged.
        error = float(np.exp(np.mean(np.log(trials)))) / tracer.rays**CONVERGENCE
        if error <= options.accuracy_db:
            progress.say(f"echoes: {tracer.rays} rays per pose, {error:.2g} dB between two seeds")
            return tracer.rays
        factor = (error / options.accuracy_db) ** (1.0 / CONVERGENCE)
        tracer.rays = min(MAX_RAYS, _rounded(tracer.rays * float(np.clip(factor, *RAYS_FACTOR))))
    progress.say(
        f"echoes: {MAX_RAYS} rays per pose, the most that are chosen; fewer were less accurate "
        f"than simulation.accuracy_db ({options.accuracy_db:g} dB); simulation.rays=NUMBER takes "
        "more"
    )
    return tracer.rays


def _difference(simulator: Simulator, poses: Poses, task: Task, workers: int | None) -> float:
    """Return the mean difference between two seeds over active cells, dB."""
    quiet = copy.copy(simulator)
    quiet.head = simulator.head.without_noise()
    spectrograms: dict[int, Singles] = {}
    twice = Poses(*(np.concatenate([part, part]) for part in (poses.positions, poses.rotations)))
    indices = list(range(len(twice)))
    with closing(simulated(quiet, twice, indices, lambda index: index, workers=workers)) as results:
        for index, spectrogram in results:
            spectrograms[index] = spectrogram
            task.advance()
    first, second = (
        np.stack([spectrograms[index + after] for index in range(len(poses))])
        for after in (0, len(poses))
    )
    loudest = float(max(first.max(), second.max()))
    if loudest <= 0.0:
        return 0.0
    reference = loudest * 10.0 ** (-RANGE_DB / 20.0)
    return mae_db(compress(first, reference), compress(second, reference), active=True) or 0.0


def _rounded(rays: float) -> int:
    """Round up to two digits, so that rounding errors do not show in the number."""
    unit = 10 ** max(len(str(round(rays))) - 2, 0)
    return int(-(-rays // unit) * unit)
