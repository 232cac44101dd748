# SPDX-License-Identifier: MIT
"""Echoes traced off a surface, and their weight beside the rendered ones."""

from __future__ import annotations

import logging
from dataclasses import dataclass, replace

import numpy as np
import trimesh
from numpy.typing import ArrayLike

from sononerf.array_types import Floats, Ints, Singles
from sononerf.echoes.echoes import Echoes
from sononerf.errors import ResourceError, SonoNerfError
from sononerf.evaluation.interval import learn_interval
from sononerf.field.fitting import render_poses
from sononerf.field.module import EchoModule
from sononerf.geometry.poses import Poses
from sononerf.head.decibels import compress
from sononerf.head.head import Head
from sononerf.progress import Progress
from sononerf.settings.schema import SimulationSettings
from sononerf.simulation.ensemble import spectrograms
from sononerf.simulation.simulator import Simulator

logger = logging.getLogger("sononerf")

RAYS = 100_000
"""Rays per pose. Echoes of the true three spheres differ from those of 300,000 rays by 0.1 dB over
active cells; with 30,000 rays by 0.2 dB."""
GAIN_POSES = 12
"""Number of training poses that give the gain."""


@dataclass(frozen=True, eq=False)
class Traced:
    """A surface to trace echoes off, and the weight of these echoes in the prediction.

    Attributes:
        mesh: The surface, m.
        gain_db ((E, F), dB): Level that is added to the traced echoes.
        weight (F,): Weight of the traced echoes in the mean with the rendered ones, 0 to 1.
        fault: The reason why no echoes can be traced off the surface; empty where they can.
        half_db ((L, F), dB): Half the width of the prediction's interval, see
            :mod:`sononerf.evaluation.interval`; None where it is unknown.
        simulator: Simulator of the surface, with what it has solved for; made anew where None.
    """

    mesh: trimesh.Trimesh
    gain_db: Floats
    weight: Floats
    fault: str = ""
    half_db: Floats | None = None
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
    wanted = (measured - rendered).reshape(-1, count)
    apart = (traced - rendered).reshape(-1, count)
    weights = np.zeros(count)
    for row in range(count):
        known = np.abs(apart[:, row]) > 0
        if known.any():
            slope = wanted[known, row] / apart[known, row]
            weights[row] = _weighted_median(slope, np.abs(apart[known, row]))
    return weights.clip(0.0, 1.0)


def _weighted_median(values: Floats, weights: Floats) -> float:
    order = values.argsort(kind="stable")
    total = weights[order].cumsum()
    return float(values[order][np.searchsorted(total, 0.5 * total[-1])])
