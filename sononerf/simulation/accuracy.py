# SPDX-License-Identifier: MIT
"""Number of rays for a wanted accuracy: that at which two simulations of a pose agree."""

from __future__ import annotations

import copy
from contextlib import closing

import numpy as np

from sononerf.geometry.poses import Poses
from sononerf.head.decibels import RANGE_DB, compress, mae_db
from sononerf.numerics import Singles
from sononerf.progress import Progress, Task
from sononerf.settings.schema import SimulationSettings
from sononerf.simulation.simulator import Simulator
from sononerf.simulation.workers import simulated

FIRST = 30_000
"""Rays per pose of the first trial. Fewer rays hardly save time."""
MOST = 300_000
"""Largest number of rays per pose that the search for an accuracy takes. Sound that bounces between
many bodies converges slowly: with this number ``ua`` has 0.8 dB, and 0.2 dB would take ten times as
many."""
POSES = 8
"""Poses that are simulated twice in a trial, spread evenly over all of them."""
CONVERGENCE = 0.6
"""The difference is proportional to the number of rays to the power -CONVERGENCE, measured from
30,000 to 300,000 rays on ``three_spheres``; on ``ua`` the power is 0.4."""
LEAST_DB = 1e-6
"""Difference below which two simulations are the same, dB."""
STEP = 1.3, 10.0
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
    chosen = np.unique(np.linspace(0, len(poses) - 1, POSES).round().astype(int))
    some = Poses(poses.positions[chosen], poses.rotations[chosen])
    tracer.rays = FIRST
    trials: list[float] = []  # errors, scaled to one ray per pose
    while tracer.rays < MOST:
        with progress.task(f"trying {tracer.rays} rays per pose", 2 * len(chosen)) as task:
            found = max(_difference(simulator, some, task, workers), LEAST_DB)
        trials.append(found * tracer.rays**CONVERGENCE)
        # A trial of so few poses is uncertain by a tenth or more, so all trials are averaged.
        error = float(np.exp(np.mean(np.log(trials)))) / tracer.rays**CONVERGENCE
        if error <= options.accuracy_db:
            progress.say(f"echoes: {tracer.rays} rays per pose, {error:.2g} dB between two seeds")
            return tracer.rays
        factor = (error / options.accuracy_db) ** (1.0 / CONVERGENCE)
        tracer.rays = min(MOST, _rounded(tracer.rays * float(np.clip(factor, *STEP))))
    progress.say(
        f"echoes: {MOST} rays per pose, the most that are chosen; fewer were less accurate than "
        f"simulation.accuracy_db ({options.accuracy_db:g} dB); simulation.rays=NUMBER takes more"
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
