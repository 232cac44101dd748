# SPDX-License-Identifier: MIT
"""Echoes traced off a surface, which complete the prediction that the field renders."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import torch
import trimesh
from numpy.typing import NDArray

from sononerf.echoes.echoes import Echoes
from sononerf.errors import SonoNerfError
from sononerf.evaluation.mixture import gain_db, regress_weight
from sononerf.field.fitting import FittedField, poses_of, render_poses
from sononerf.field.range_slices import WholePoses
from sononerf.head.decibels import compress
from sononerf.head.head import Head
from sononerf.progress import Progress
from sononerf.settings.schema import SimulationSettings
from sononerf.simulation.simulator import Simulator

RAYS = 100_000
"""Rays per pose. Echoes of the true three spheres differ from those of 300,000 rays by 0.1 dB over
active cells; with 30,000 rays by 0.2 dB."""
GAIN_POSES = 12
"""Number of training poses that give the gain."""


@dataclass(frozen=True, eq=False)
class Traced:
    """A surface to trace echoes off, and the weight of these echoes in the prediction.

    Attributes
    ----------
    mesh : Trimesh
        The surface, m.
    gain_db : (E, F) float, dB
        Level that is added to the traced echoes.
    weight : (F,) float
        Weight of the traced echoes in the mean with the rendered ones, 0 to 1.
    """

    mesh: trimesh.Trimesh
    gain_db: NDArray[np.float64]
    weight: NDArray[np.float64]

    @classmethod
    def none(cls, mesh: trimesh.Trimesh, head: Head) -> Traced:
        """Return a surface whose traced echoes have no weight."""
        ears, rows = len(head.receivers), len(head.frequency)
        return cls(mesh, np.zeros((ears, rows)), np.zeros(rows))


def learn_traced(
    fitted: FittedField,
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

    Parameters
    ----------
    fitted : FittedField
        What is rendered.
    echoes : Echoes
        What was measured.
    mesh : Trimesh
        The surface, m.
    simulation : SimulationSettings
        Of the surface's echoes; engine and number of rays are replaced.
    seed : int
        Of the rays.
    accelerator : {"auto", "cpu", "gpu"}
        What the field is rendered on.
    progress : Progress
        Where to show it.

    Returns
    -------
    traced : Traced
        Of weight zero where there are no validation poses, or nothing can be traced off the
        surface.
    """
    renderer, reference = fitted.module.renderer, fitted.module.reference
    training = poses_of(echoes, "train", renderer)
    validation = poses_of(echoes, "val", renderer)
    nothing = Traced.none(mesh, fitted.head)
    if not len(validation):
        return nothing
    numbers = np.linspace(0, len(training) - 1, min(GAIN_POSES, len(training))).astype(int)
    some = training.only(torch.as_tensor(numbers))
    try:
        simulator = Simulator.of_surface(mesh, fitted.head, simulation, rays=RAYS)
        both = zip(_places(some), _places(validation), strict=True)
        positions, rotations = (np.concatenate(parts) for parts in both)
        simulator.prepare(positions, rotations, progress)
        traced = compress(_trace(simulator, some, seed, progress), reference)
        gain = gain_db(compress(_measured(some), reference), traced)
        traced = _trace(simulator, validation, seed, progress)
    except SonoNerfError as error:  # some meshes can be drawn but not simulated
        progress.say(f"no echoes are traced off the surface: {error}")
        return nothing
    traced = compress(traced * 10 ** (gain[:, None] / 20), reference)
    rendered = render_poses(fitted, validation, accelerator=accelerator, progress=progress)
    measured = compress(_measured(validation), reference)
    return Traced(mesh, gain, regress_weight(measured, compress(rendered, reference), traced))


def trace_poses(
    traced: Traced,
    head: Head,
    poses: WholePoses,
    simulation: SimulationSettings,
    *,
    seed: int,
    progress: Progress,
) -> NDArray[np.float64]:
    """Trace echoes off the surface, (P, E, R, F) linear magnitude, without noise."""
    simulator = Simulator.of_surface(traced.mesh, head, simulation, rays=RAYS)
    simulator.prepare(*_places(poses), progress)
    found = _trace(simulator, poses, seed, progress)
    return found * 10 ** (traced.gain_db[:, None] / 20)


def _measured(poses: WholePoses) -> NDArray[np.float32]:
    return np.concatenate([poses[i].spectrum.numpy() for i in range(len(poses))])


def _places(poses: WholePoses) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    positions, rotations = (
        np.stack([part.double().numpy() for part in parts])
        for parts in (poses.positions, poses.rotations)
    )
    return positions, rotations


def _trace(
    simulator: Simulator, poses: WholePoses, seed: int, progress: Progress
) -> NDArray[np.float64]:
    """Return the spectrograms of poses (P, E, R, F), linear."""
    traced = []
    with progress.task("tracing", len(poses)) as task:
        for place, turn in zip(*_places(poses), strict=True):
            traced.append(simulator.spectrogram(place, turn, seed=seed))
            task.advance()
    return np.stack(traced).astype(np.float64)
