# SPDX-License-Identifier: MIT
"""Echoes traced off a surface, their weight beside the rendered ones, and intervals around both.

An interval holds 90 % of the measured levels, by split conformal prediction [1]_: the quantile of
the absolute errors on validation poses, in classes of the predicted level and of the frequency. It
holds for poses drawn like these.

References:
    .. [1] J. Lei et al., "Distribution-free predictive inference for regression", JASA 113, 2018.
"""

from __future__ import annotations

import logging
import math
from dataclasses import dataclass, replace

import numpy as np
import trimesh
from numpy.typing import ArrayLike

from sononerf.echoes.echoes import Echoes
from sononerf.errors import ResourceError, SonoNerfError
from sononerf.field.fitting import render_poses
from sononerf.field.module import EchoModule
from sononerf.geometry.poses import Poses
from sononerf.head.front_end import RANGE_DB, compress
from sononerf.head.head import Head
from sononerf.numerics import Floats, Ints, Singles
from sononerf.progress import Progress
from sononerf.settings.schema import SimulationSettings
from sononerf.simulation.ensemble import spectrograms
from sononerf.simulation.simulator import Simulator

COVERED_FRACTION = 0.9
"""Fraction of the active cells that an interval holds."""
STEP_DB = 6.0
"""Width of a class of predicted levels, dB: a factor of two in magnitude."""
CLASSES = round(RANGE_DB / STEP_DB)
BANDS = 6
"""Number of classes of frequency: with ten poses each class holds some hundred cells."""
MIN_CLASS_CELLS = 50
"""Number of active cells below which a class takes the quantile of its level at all frequencies."""


def learn_interval(
    measured_db: ArrayLike, predicted_db: ArrayLike, active_db: float | Floats
) -> Floats:
    """Return half the width of the interval by class.

    In: measured_db, predicted_db ((P, E, R, F), dB), active_db (dB). Out: half_db ((CLASSES, F),
    dB).
    """
    measured, predicted = (np.asarray(a, dtype=np.float64) for a in (measured_db, predicted_db))
    error = np.abs(measured - predicted)
    active = (measured >= active_db) | (predicted >= active_db)
    level, count = level_class(predicted), predicted.shape[-1]
    half = np.full((CLASSES, count), RANGE_DB)  # nothing is known
    classes = [one for one in range(CLASSES) if (active & (level == one)).any()]
    for one in classes:
        some = active & (level == one)
        usual = _quantile(error[some])
        for band in np.array_split(np.arange(count), min(BANDS, count)):
            found = error[..., band][some[..., band]]
            half[one, band] = usual if len(found) < MIN_CLASS_CELLS else _quantile(found)
    for one in range(CLASSES) if classes else ():  # others are as uncertain as the next lower one
        half[one] = half[max((other for other in classes if other <= one), default=classes[0])]
    return half


def interval_db(predicted_db: ArrayLike, half_db: Floats) -> Floats:
    """Return half the width of the interval of each cell, dB.

    In: predicted_db ((..., F), dB), half_db ((CLASSES, F), dB).
    """
    level = level_class(predicted_db)
    return half_db[level, np.arange(level.shape[-1])]


def level_class(predicted_db: ArrayLike) -> Ints:
    """Return the class of predicted levels, 0 to ``CLASSES`` - 1."""
    return (np.asarray(predicted_db) / STEP_DB).astype(np.int64).clip(0, CLASSES - 1)


def _quantile(errors: Floats) -> float:
    """Return the error that a new one exceeds at most in one minus ``COVERED_FRACTION``."""
    rank = min(math.ceil((len(errors) + 1) * COVERED_FRACTION), len(errors))
    return float(np.partition(errors, rank - 1)[rank - 1])


def covered(
    measured_db: ArrayLike, predicted_db: ArrayLike, half_db: ArrayLike, active_db: float | Floats
) -> float | None:
    """Return the fraction of the active cells whose measured level lies within the interval.

    In: measured_db, predicted_db ((P, E, R, F), dB), half_db ((P, E, R, F), dB), active_db (dB).
    """
    measured, predicted = (np.asarray(a, dtype=np.float64) for a in (measured_db, predicted_db))
    active = (measured >= active_db) | (predicted >= active_db)
    within = (np.abs(measured - predicted) <= half_db)[active]
    return float(within.mean()) if len(within) else None


logger = logging.getLogger("sononerf")

RAYS = 30_000
"""Rays per pose. Echoes of the true three spheres differ from those of 300,000 rays by 0.1 dB over
active cells; with 10,000 rays by 0.2 dB."""
GAIN_POSES = 12
"""Number of training poses that give the gain."""


@dataclass(frozen=True, eq=False)
class Traced:
    """A surface to trace echoes off, and the weight of these echoes in the prediction."""

    mesh: trimesh.Trimesh  # The surface, m
    gain_db: Floats  # (E, F), dB: Level that is added to the traced echoes
    weight: Floats  # (F,): Weight of the traced echoes in the mean with the rendered ones, 0 to 1
    fault: str = ""  # The reason why no echoes can be traced off the surface; empty where they can
    # (L, F), dB: Half the width of the prediction's interval, see
    # :mod:`sononerf.evaluation.traced`; None where it is unknown
    half_db: Floats | None = None
    # Simulator of the surface, with what it has solved for; made anew where None
    simulator: Simulator | None = None

    @classmethod
    def none(cls, mesh: trimesh.Trimesh, head: Head, fault: str = "") -> Traced:
        """Return a surface whose traced echoes have no weight."""
        ears, rows = len(head.receivers), len(head.frequency)
        return cls(mesh, np.zeros((ears, rows)), np.zeros(rows), fault)


def learn_traced(
    model: EchoModule,
    echoes: Echoes,
    mesh: trimesh.Trimesh,
    simulation: SimulationSettings,
    *,
    seed: int,
    accelerator: str = "auto",
    progress: Progress,
) -> Traced:
    """Find gain and weight of the echoes that are traced off a surface.

    The gain per ear and frequency comes from training poses, the weight per frequency from one
    regression on the validation poses. Held-out poses take no part.
    """
    reference, head, store = model.reference, echoes.head, echoes.store
    training, validation = store.indices("train"), store.indices("val")
    if not len(validation):
        return Traced.none(mesh, head, "there are no validation poses")
    some = training[np.linspace(0, len(training) - 1, min(GAIN_POSES, len(training))).astype(int)]
    try:
        simulator = Simulator.of_surface(mesh, head, simulation, rays=RAYS)
        # The prediction will need the test poses. Their echoes are not read here.
        numbers = np.concatenate([some, validation, store.indices("test")])
        positions, rotations = echoes.positions[numbers], echoes.rotations[numbers]
        simulator.prepare(positions, rotations, progress)
        count = len(some) + len(validation)
        heard = _trace(simulator, positions[:count], rotations[:count], seed, progress)
        gain = gain_db(
            compress(_measured(echoes, some), reference), compress(heard[: len(some)], reference)
        )
        traced = heard[len(some) :]
    except ResourceError:
        raise  # another time there may be more memory
    except SonoNerfError as error:  # some meshes can be drawn but not simulated
        logger.warning("no echoes are traced off the surface: %s", error)
        return Traced.none(mesh, head, str(error))
    traced = compress(traced * 10 ** (gain[:, None] / 20), reference)
    poses = echoes.poses("val")
    rendered = render_poses(model, poses, accelerator=accelerator, progress=progress)
    measured = compress(_measured(echoes, validation), reference)
    alone = compress(rendered, reference)
    weight = regress_weight(measured, alone, traced)
    half = learn_interval(measured, mix(alone, traced, weight), echoes.active_db)
    return Traced(mesh, gain, weight, half_db=half, simulator=simulator)


def for_single_poses(traced: Traced, head: Head, simulation: SimulationSettings) -> Traced:
    """Return a surface whose simulator answers poses that come one by one in tenths of a second.

    The first one takes seconds, and 400 MB are kept for three spheres.
    """
    if not traced.weight.any():
        return traced
    simulator = Simulator.of_surface(traced.mesh, head, simulation, rays=RAYS)
    simulator.keep_equations()
    return replace(traced, simulator=simulator)


def trace_poses(
    traced: Traced,
    head: Head,
    poses: Poses,
    simulation: SimulationSettings,
    *,
    seed: int,
    progress: Progress,
) -> Floats:
    """Trace echoes off the surface, (P, E, R, F) linear magnitude, without noise."""
    simulator = traced.simulator or Simulator.of_surface(traced.mesh, head, simulation, rays=RAYS)
    places = poses.positions, poses.rotations
    simulator.prepare(*places, progress)
    found = _trace(simulator, *places, seed, progress)
    return found * 10 ** (traced.gain_db[:, None] / 20)


def _measured(echoes: Echoes, numbers: Ints) -> Singles:
    return np.stack([echoes.spectrogram(int(number)) for number in numbers])


def _trace(
    simulator: Simulator, positions: Floats, rotations: Floats, seed: int, progress: Progress
) -> Floats:
    """Return the spectrograms of poses (P, E, R, F), linear."""
    with progress.task("tracing", len(positions)) as task:
        found = spectrograms(simulator, positions, rotations, seed=seed, done=task.advance)
    return found.astype(np.float64)


LOUD_DB = 20.0
"""Cells above this level, in reported decibels, give the gain: fainter ones hold the window's side
lobes and interference."""


def gain_db(measured_db: ArrayLike, traced_db: ArrayLike) -> Floats:
    """Return the level of the measurement over that of the traced echoes, by ear and frequency.

    In: measured_db, traced_db ((P, E, R, F), dB). Out: gain ((E, F), dB).
    """
    measured, traced = (np.asarray(a, dtype=np.float64) for a in (measured_db, traced_db))
    loud = (measured > LOUD_DB) & (traced > LOUD_DB)
    apart = measured - traced
    ears, rows = measured.shape[1], measured.shape[3]
    gain = np.zeros((ears, rows))
    for ear, row in np.ndindex(ears, rows):
        some = loud[:, ear, :, row]
        if some.any():
            gain[ear, row] = np.median(apart[:, ear, :, row][some])
    return gain


def mix(rendered_db: ArrayLike, traced_db: ArrayLike, weight: ArrayLike) -> Floats:
    """Return the weighted mean of two predictions in decibels.

    In: rendered_db, traced_db ((..., F), dB), weight (F,). Out: (..., F).
    """
    first = np.asarray(rendered_db, dtype=np.float64)
    return first + np.asarray(weight) * (np.asarray(traced_db, dtype=np.float64) - first)


def regress_weight(measured_db: ArrayLike, rendered_db: ArrayLike, traced_db: ArrayLike) -> Floats:
    r"""Return the weight of the traced prediction that minimises the error per frequency.

    The weight minimises :math:`\sum |m - r - w (t - r)|` with :math:`0 \le w \le 1` over all
    cells of a frequency: least absolute deviations, as the reported error is. With one unknown the
    solution is the median of :math:`(m - r) / (t - r)`, weighted by :math:`|t - r|`.

    In: measured_db, rendered_db, traced_db ((..., F), dB). Out: weight (F,).
    """
    measured, rendered, traced = (
        np.asarray(a, dtype=np.float64) for a in (measured_db, rendered_db, traced_db)
    )
    count = measured.shape[-1]
    target = (measured - rendered).reshape(-1, count)
    apart = (traced - rendered).reshape(-1, count)
    weights = np.zeros(count)
    for row in range(count):
        known = np.abs(apart[:, row]) > 0
        if known.any():
            slope = target[known, row] / apart[known, row]
            weights[row] = _weighted_median(slope, np.abs(apart[known, row]))
    return weights.clip(0.0, 1.0)


def _weighted_median(values: Floats, weights: Floats) -> float:
    order = values.argsort(kind="stable")
    total = weights[order].cumsum()
    return float(values[order][np.searchsorted(total, 0.5 * total[-1])])
