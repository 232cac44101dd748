# SPDX-License-Identifier: MIT
"""Simulate poses in this process, in other processes of this machine, or on a Dask cluster."""

from __future__ import annotations

from collections.abc import Callable, Generator

from sononerf.errors import SonoNerfError
from sononerf.executor import TaskError, computed, preload
from sononerf.geometry.poses import Poses
from sononerf.memory import available_cores
from sononerf.numerics import Floats, Singles
from sononerf.simulation.simulator import Simulator

MOST_WORKERS = 8
WORTH_RAYS = 250_000
"""Rays of all poses from which other processes save time: fewer are traced before these start."""

READY = "sononerf.simulation.ready"
"""What worker processes have imported when they start."""
preload(READY)

Results = Generator[tuple[int, Singles], None, None]
SeedOf = Callable[[int], int]
"""Gives the seed of a pose by its index."""


def useful_workers(poses: int, rays: int) -> int:
    """Return the number of processes that simulates the poses soonest; one means this process."""
    return min(available_cores(), MOST_WORKERS) if poses * rays >= WORTH_RAYS else 1


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
