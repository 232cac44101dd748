# SPDX-License-Identifier: MIT
"""Echoes traced off a run's surface, which complete the prediction that the field renders."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np
import safetensors.torch
import torch
import trimesh
from numpy.typing import NDArray
from safetensors import SafetensorError, safe_open

from sononerf import storage
from sononerf.errors import InputError, SonoNerfError
from sononerf.evaluation.mixture import gain_db, regress_weight
from sononerf.field.range_slices import WholePoses
from sononerf.field.weights import model_checksum
from sononerf.head.decibels import compress
from sononerf.progress import Progress
from sononerf.run.fitted import Fitted, load_fitted, poses_of, render_poses, store_of
from sononerf.run.reconstruct import read_mesh
from sononerf.run.refine import surface_simulator
from sononerf.run.simulate import prepare
from sononerf.simulation.simulator import Simulator

NAME = "traced.safetensors"
RAYS = 100_000
"""Per pose. Off the true three spheres they differ from 300,000 by 0.1 dB over active cells, and
30,000 by 0.2 dB."""
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
        Is added to the traced level.
    weight : (F,) float
        Of the traced echoes in the mean with the rendered ones, 0 to 1.
    """

    mesh: trimesh.Trimesh
    gain_db: NDArray[np.float64]
    weight: NDArray[np.float64]


def learn_traced(
    path: Path, *, accelerator: str = "auto", progress: Progress | None = None
) -> NDArray[np.float64]:
    """Find the weight of echoes traced off a run's surface, and write ``RUN/traced.safetensors``.

    The gain per ear and frequency comes from training poses, the weight per frequency from one
    regression on the validation poses. Held-out poses take no part.

    Parameters
    ----------
    path : Path
        A run that was reconstructed.
    accelerator : {"auto", "cpu", "gpu"}
        What the field is rendered on.
    progress : Progress or None
        Where to show it.

    Returns
    -------
    weight : (F,) float
        Zero where there are no validation poses, or nothing can be traced off the surface.
    """
    progress = progress or Progress(quiet=True)
    fitted = load_fitted(path)
    store, reference = store_of(fitted), fitted.module.reference
    renderer, options = fitted.module.renderer, fitted.settings
    mesh = read_mesh(path / "reconstruction" / "mesh.ply")
    ears, rows = len(renderer.ear_positions), len(renderer.frequency)
    nothing = Traced(mesh, np.zeros((ears, rows)), np.zeros(rows))
    training = poses_of(store, "train", renderer)
    validation = poses_of(store, "val", renderer)
    if options.prediction.traced == "off" or not len(validation):
        return _keep(path, nothing)
    numbers = np.linspace(0, len(training) - 1, min(GAIN_POSES, len(training))).astype(int)
    some = training.only(torch.as_tensor(numbers))
    try:
        simulator = surface_simulator(fitted.head, options.simulation, mesh, rays=RAYS)
        both = zip(_places(some), _places(validation), strict=True)
        positions, rotations = (np.concatenate(parts) for parts in both)
        prepare(simulator, positions, rotations, progress)
        traced = compress(_trace(simulator, some, options.fit.seed, progress), reference)
        gain = gain_db(compress(_measured(some), reference), traced)
        traced = _trace(simulator, validation, options.fit.seed, progress)
    except SonoNerfError as error:  # the simulator asks more of a mesh than a picture does
        progress.say(f"no echoes are traced off the surface: {error}")
        return _keep(path, nothing)
    traced = compress(traced * 10 ** (gain[:, None] / 20), reference)
    rendered = render_poses(fitted, validation, accelerator=accelerator, progress=progress)
    measured = compress(_measured(validation), reference)
    weight = regress_weight(measured, compress(rendered, reference), traced)
    return _keep(path, Traced(mesh, gain, weight))


def trace_poses(
    fitted: Fitted, traced: Traced, poses: WholePoses, *, progress: Progress
) -> NDArray[np.float64]:
    """Trace echoes off the surface, (P, E, R, F) linear magnitude, without noise."""
    simulator = surface_simulator(fitted.head, fitted.settings.simulation, traced.mesh, rays=RAYS)
    prepare(simulator, *_places(poses), progress)
    found = _trace(simulator, poses, fitted.settings.fit.seed, progress)
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


def _keep(path: Path, traced: Traced) -> NDArray[np.float64]:
    tensors = {
        "vertices": torch.as_tensor(np.array(traced.mesh.vertices, dtype=np.float64)),
        "faces": torch.as_tensor(np.array(traced.mesh.faces, dtype=np.int64)),
        "gain_db": torch.as_tensor(traced.gain_db),
        "weight": torch.as_tensor(traced.weight),
    }
    data = safetensors.torch.save(tensors, metadata={"model": model_checksum(path)})
    storage.commit_bytes(path / NAME, data)
    return traced.weight


def load_traced(path: Path) -> Traced | None:
    """Read ``RUN/traced.safetensors``; None where there is none, or it belongs to another fit.

    Raises
    ------
    InputError
        If it is damaged.
    """
    file = path / NAME
    if not file.is_file():
        return None
    try:
        with safe_open(str(file), "pt") as opened:
            found = {name: opened.get_tensor(name).numpy() for name in opened.keys()}
            model = (opened.metadata() or {}).get("model")
        if model != model_checksum(path):
            return None
        faces, vertices = found["faces"], found["vertices"]
        gain, weight = found["gain_db"], found["weight"]
        if not (np.isfinite(vertices).all() and np.isfinite(gain).all()):
            raise ValueError("numbers that are not finite")
        if not ((weight >= 0) & (weight <= 1)).all():
            raise ValueError("weights outside 0 to 1")
        if len(faces) and not 0 <= int(faces.min()) <= int(faces.max()) < len(vertices):
            raise ValueError("a triangle names a vertex that is not there")
        return Traced(trimesh.Trimesh(vertices, faces, process=False), gain, weight)
    except (SafetensorError, KeyError, ValueError, OSError) as error:
        raise InputError(
            f"{file}: damaged ({error}); remove it, and `sononerf fit` makes it again"
        ) from None
