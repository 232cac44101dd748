# SPDX-License-Identifier: MIT
"""Many poses: which ones, whether they make sense, and all their spectrograms."""

from __future__ import annotations

import logging
from collections.abc import Callable, Collection, Iterable
from contextlib import closing
from functools import partial

import numpy as np
from numpy.typing import ArrayLike

from sononerf.array_types import Bools, Floats, Singles
from sononerf.echoes.store import EnsembleStore, seal
from sononerf.errors import InputError, NumericalError
from sononerf.geometry.poses import Poses
from sononerf.geometry.raycast import winding_numbers
from sononerf.progress import Progress
from sononerf.scene.scene import Scene
from sononerf.settings.schema import SimulationSettings
from sononerf.simulation.accuracy import MOST, settle_rays
from sononerf.simulation.simulator import Simulator, pose_seed
from sononerf.simulation.workers import SeedOf, simulated

logger = logging.getLogger("sononerf")

Write = Callable[[int, Singles], None]


def check_poses(scene: Scene, poses: Poses, *, offsets: Floats | None = None) -> None:
    """Refuse poses that are no numbers or lie inside the surface.

    Args:
        scene: What is ensonified.
        poses: To be checked.
        offsets ((K, 3), m): Further points of the head that must be outside, such as emitter and
            ears; head frame.
    """
    finite = np.isfinite(poses.positions).all(axis=1) & np.isfinite(poses.rotations).all((1, 2))
    _refuse(~finite, "no finite numbers")
    points = np.zeros((1, 3)) if offsets is None else np.vstack([np.zeros((1, 3)), offsets])
    places = poses.positions[:, None] + np.einsum("pij,kj->pki", poses.rotations, points)
    winding = winding_numbers(scene.mesh.vertices, scene.mesh.faces, places.reshape(-1, 3))
    inside = np.abs(winding.reshape(places.shape[:2])) > 0.5
    _refuse(inside.any(axis=1), "inside the scene's surface")


def _refuse(bad: ArrayLike, what: str) -> None:
    bad = np.asarray(bad)
    if bad.any():
        raise InputError(f"{_named(bad)} {what}; move them, or raise poses.radius")


def _named(bad: Bools) -> str:
    """Say how many poses there are of a kind, and which are the first ten."""
    indices = np.flatnonzero(bad)
    listed = ", ".join(str(index) for index in indices[:10])
    return (
        f"{len(indices)} of {len(bad)} poses ({listed}{', ...' if len(indices) > 10 else ''}) are"
    )


def check_reach(
    scene: Scene, poses: Poses, *, bounces: int, range_min: float, range_max: float
) -> None:
    """Warn of poses that no echo can reach within the range limits.

    Args:
        scene: What is ensonified.
        poses: To be checked.
        bounces: How often sound may hit.
        range_min, range_max (m): The limits of the spectrograms.

    Raises:
        NumericalError: If it is so for all poses; the tails of the analysis would pass for echoes.
    """
    lower, upper = np.asarray(scene.mesh.bounds)
    radius = float(np.linalg.norm(upper - lower)) / 2.0
    nearest = np.linalg.norm(poses.positions - np.clip(poses.positions, lower, upper), axis=1)
    distance = np.linalg.norm(poses.positions - (lower + upper) / 2.0, axis=1)
    far, near = nearest > range_max, distance + bounces * radius < range_min
    if (far | near).all():
        raise NumericalError(deaf(range_min, range_max))
    for bad, what, limit in (
        (far, "farther from the scene than range_max", range_max),
        (near, "nearer to all of the scene than range_min", range_min),
    ):
        if bad.any():
            logger.warning(
                "%s %s (%g m) and will hear nothing; set spectrogram.range_%s, or move them",
                *(_named(bad), what, limit, "max" if bad is far else "min"),
            )


def deaf(range_min: float, range_max: float) -> str:
    """Say that no pose hears anything within the range limits."""
    return (
        f"no pose received an echo between {range_min} and {range_max} m; check poses.radius, "
        "the scene's size (of a file, its unit) and the range limits"
    )


def simulate(
    simulator: Simulator,
    poses: Poses,
    store: EnsembleStore,
    options: SimulationSettings,
    *,
    only: Collection[int] | None = None,
    workers: int | None = None,
    scheduler: str | None = None,
    progress: Progress,
) -> None:
    """Simulate what is missing of a store, and seal it.

    The test poses are simulated twice, with other rays, which gives the noise floor.

    Args:
        simulator: Scene and head.
        poses: Those of the store.
        store: Opened for writing.
        options: Seed, and number of test poses for the noise floor.
        only: Of these poses alone; the store is then not sealed.
        workers: Processes; as many as there are cores, at most 8, where None.
        scheduler: Address of a Dask scheduler to use instead.
        progress: Where to show it.
    """
    missing = [index for index in store.missing() if only is None or index in only]
    test = store.indices("test")[: options.noise_floor_poses if only is None else 0]
    again: dict[int, Singles] = {}
    wanted = [*missing, *test]
    simulator.prepare(poses.positions[wanted], poses.rotations[wanted], progress)
    known = store.attributes.get("rays")
    if options.rays is None and isinstance(known, int) and 0 < known <= MOST:
        # An interrupted simulation goes on with the number that it began with.
        options = options.model_copy(update={"rays": known})
    here = 1 if scheduler is not None else workers
    rays = settle_rays(simulator, poses, options, progress, workers=here)
    store.update_attributes(rays=rays)
    with progress.task("simulating", len(missing) + len(test)) as task:
        # The second simulation of the test poses goes first where it can share the processes.
        def keep(index: int, spectrogram: Singles) -> None:
            if index < len(poses):
                store.write_pose(index, spectrogram)
            else:
                again[int(test[index - len(poses)])] = spectrogram
            task.advance()

        both = Poses(
            np.concatenate((poses.positions, poses.positions[test])),
            np.concatenate((poses.rotations, poses.rotations[test])),
        )
        extra = range(len(poses), len(poses) + len(test))
        simulate_ensemble(
            simulator,
            both,
            [*missing, *extra],
            keep,
            # A pose's seed is a function of its number, so the second time has other rays.
            seed_of=partial(pose_seed, options.seed),
            workers=workers,
            scheduler=scheduler,
        )
    if only is not None:
        return
    analysis = simulator.head.analysis
    silent = deaf(analysis.range_min, analysis.range_max)
    seal(store, {int(i): again[int(i)] for i in test}, silent=silent)


def simulate_ensemble(
    simulator: Simulator,
    poses: Poses,
    indices: Iterable[int],
    write: Write,
    *,
    seed_of: SeedOf,
    workers: int | None = None,
    scheduler: str | None = None,
) -> None:
    """Simulate poses and hand over each spectrogram as it comes.

    The result of a pose depends on its seed alone, not on workers or order.

    Args:
        simulator: Scene and head.
        poses: All poses of the ensemble.
        indices: Which of them to simulate.
        write: Takes an index and its spectrogram (E, R, F); called here, one at a time.
        seed_of: Gives the seed of a pose by its index.
        workers: Processes on this machine; one means this process. Where None, as many as there are
            cores, at most 8, if they save time.
        scheduler: Address of a Dask scheduler whose workers are used instead.
    """
    wanted = [int(index) for index in indices]
    results = simulated(simulator, poses, wanted, seed_of, workers=workers, scheduler=scheduler)
    # Closed at once where a write fails: what runs elsewhere ends before the error is seen.
    with closing(results):
        for index, spectrogram in results:
            write(index, spectrogram)


def spectrograms(
    simulator: Simulator,
    positions: Floats,
    rotations: Floats,
    *,
    seed: int,
    done: Callable[[], None] | None = None,
) -> Singles:
    """Return the spectrograms of poses (P, E, R, F), linear magnitude, with the same rays for each.

    Args:
        simulator: Scene and head.
        positions ((P, 3), m): Of the head, world frame.
        rotations (P, 3, 3): Head to world.
        seed: Of the rays.
        done: Called after each pose.
    """
    found: dict[int, Singles] = {}

    def keep(index: int, spectrogram: Singles) -> None:
        found[index] = spectrogram
        if done is not None:
            done()

    poses = Poses(positions, rotations)
    simulate_ensemble(simulator, poses, range(len(poses)), keep, seed_of=lambda _: seed)
    return np.stack([found[index] for index in range(len(poses))])
