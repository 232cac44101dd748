# SPDX-License-Identifier: MIT
"""Echoes traced off a run's own reconstruction, as a second opinion beside the rendered ones."""

from __future__ import annotations

import logging
from contextlib import suppress
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import safetensors.torch
import torch
import trimesh
from numpy.typing import NDArray
from safetensors import SafetensorError, safe_open

from sononerf import storage
from sononerf.acoustics.spectrogram import compress
from sononerf.config import NoiseSettings, Settings
from sononerf.data.range_slices import WholePoses
from sononerf.errors import InputError, SonoNerfError
from sononerf.experiment.borne_out import NAME, Surface, model_of
from sononerf.experiment.fitted import Fitted, load_fitted, poses_of, render_poses, store_of
from sononerf.experiment.reconstruct import read_mesh, reconstruct
from sononerf.experiment.simulate import prepare
from sononerf.progress import Progress
from sononerf.reconstruction.isosurface import isosurface
from sononerf.reconstruction.outline import clearance_volume
from sononerf.reconstruction.retrace import best_share, calmed, gain_db
from sononerf.scene import Scene
from sononerf.simulation.simulator import Simulator

RAYS = 30_000
"""Per pose. Off the true three spheres they give what 300,000 gave to 0.05 dB over all cells and
0.23 dB over active ones."""
SOURCES = 500
"""Of the low band, an eighth of the time of the default; the mesh errs more than they do."""
GAIN_POSES = 12
"""Training poses that the gain is taken from."""


@dataclass(frozen=True, eq=False)
class Retrace:
    """What echoes are traced off, and how far they are believed.

    Attributes
    ----------
    mesh : Trimesh
        The surface, m.
    gain_db : (F,) float, dB
        What is added to the traced level.
    share : float
        Part of the traced prediction in the whole, 0 to 1.
    """

    mesh: trimesh.Trimesh
    gain_db: NDArray[np.float64]
    share: float


def learn_retrace(
    path: Path, *, accelerator: str = "auto", progress: Progress | None = None
) -> float:
    """Find out how far echoes traced off a run's mesh are to be believed, and keep it.

    The gain per frequency comes from training poses, the share from the validation poses; the
    held-out ones are not looked at. Writes ``RUN/retrace.safetensors``.

    Where the settings leave open how the surface is found, it is also asked whether what the first
    echoes leave, the hull, bears out the validation poses better than the run's mesh does, and
    well enough to be believed at all; then the run is reconstructed anew. Faces that answer to few
    poses look dented to a field; where there are hollows the hull is wrong.

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
    share : float
        Zero where there are no validation poses, or nothing can be traced off the mesh.
    """
    progress = progress or Progress(quiet=True)
    fitted = load_fitted(path)
    store, reference = store_of(fitted), fitted.module.reference
    renderer = fitted.module.renderer
    options = fitted.settings
    mesh = calmed(read_mesh(path / "reconstruction" / "mesh.ply"))
    untold = np.zeros(len(renderer.frequency))
    training = poses_of(store, "train", renderer)
    validation = poses_of(store, "val", renderer)
    if options.prediction.traced == "off" or not len(validation):
        return _keep(path, Retrace(mesh, untold, 0.0), "auto")
    numbers = np.linspace(0, len(training) - 1, min(GAIN_POSES, len(training))).astype(int)
    some = training.only(torch.as_tensor(numbers))
    heard, wanted = (compress(_measured(poses), reference) for poses in (some, validation))

    def trace(mesh: trimesh.Trimesh) -> tuple[Retrace, NDArray[np.float64], float]:
        """Return what to trace off, what that gives for the validation poses, and its error."""
        simulator = _simulator(options, mesh)
        (place, turn), (other_place, other_turn) = _places(some), _places(validation)
        positions, rotations = (
            np.concatenate([place, other_place]),
            np.concatenate([turn, other_turn]),
        )
        prepare(simulator, positions, rotations, progress)
        traced = _traced(simulator, some, options.fit.seed, progress)
        tuned = Retrace(mesh, gain_db(heard, compress(traced, reference)), 1.0)
        traced = _traced(simulator, validation, options.fit.seed, progress)
        traced *= 10 ** (tuned.gain_db / 20)
        error = np.abs(compress(traced, reference) - wanted).mean()
        return tuned, traced, float(error)

    rendered = render_poses(fitted, validation, accelerator=accelerator, progress=progress)

    def believed(traced: NDArray[np.float64]) -> float:
        return best_share(_measured(validation), rendered, traced, reference)

    best, share = None, 0.0
    try:
        best = trace(mesh)
        share = believed(best[1])
    except SonoNerfError as error:  # a mesh may be sound for the eye and unfit for the simulator
        progress.say(f"no echoes are traced off the mesh: {error}")
    surface: Surface = "auto"
    read_out = options.reconstruction
    if (read_out.method, read_out.level) == ("auto", "auto"):
        with suppress(SonoNerfError):  # nor need there be a hull, or be one that can be traced
            other = trace(calmed(_hull_surface(fitted)))
            # Of two that nobody believes the better one proves nothing.
            if (best is None or other[2] < best[2]) and (heeded := believed(other[1])) > 0.0:
                best, share, surface = other, heeded, "hull"
    if best is None:
        return _keep(path, Retrace(mesh, untold, 0.0), "auto")
    if surface == "hull":
        progress.say("the surface is the hull of first echoes, which bears out unseen poses better")
        reconstruct(path, method="hull", progress=progress)
    return _keep(path, replace(best[0], share=share), surface)


def _hull_surface(fitted: Fitted) -> trimesh.Trimesh:
    field = fitted.module.field
    lower, upper = (corner.double().cpu().numpy() for corner in field.region)
    spacing = fitted.settings.reconstruction.spacing or field.resolution / 2
    return isosurface(clearance_volume(fitted.hull, lower, upper, spacing), 0.0)


def _measured(poses: WholePoses) -> NDArray[np.float32]:
    return np.concatenate([poses[i].spectrum.numpy() for i in range(len(poses))])


def trace_poses(
    settings: Settings, retrace: Retrace, poses: WholePoses, *, progress: Progress
) -> NDArray[np.float64]:
    """Trace echoes off the surface, (P, E, R, F) linear magnitude; noise is left out."""
    simulator = _simulator(settings, retrace.mesh)
    prepare(simulator, *_places(poses), progress)
    traced = _traced(simulator, poses, settings.fit.seed, progress)
    return traced * 10 ** (retrace.gain_db / 20)


def _simulator(settings: Settings, mesh: trimesh.Trimesh) -> Simulator:
    """Return the default engine on a mesh, with fewer rays and without noise."""
    sources = min(SOURCES, settings.simulation.sources)
    few = {"engine": "hybrid", "rays": RAYS, "sources": sources}
    simulation = settings.simulation.model_copy(update=few)
    changed = {"simulation": simulation, "noise": NoiseSettings()}
    return Simulator.from_settings(_scene(mesh), settings.model_copy(update=changed))


def _places(poses: WholePoses) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    positions, rotations = (
        np.stack([part.double().numpy() for part in parts])
        for parts in (poses.positions, poses.rotations)
    )
    return positions, rotations


def _traced(
    simulator: Simulator, poses: WholePoses, seed: int, progress: Progress
) -> NDArray[np.float64]:
    """Return the spectrograms of poses (P, E, R, F), linear."""
    traced = []
    with progress.task("tracing", len(poses)) as task:
        for place, turn in zip(*_places(poses), strict=True):
            traced.append(simulator.spectrogram(place, turn, seed=seed))
            task.advance()
    return np.stack(traced).astype(np.float64)


def _scene(mesh: trimesh.Trimesh) -> Scene:
    """Return a scene of our own mesh; what a user should know of a mesh is of no use here."""
    talker = logging.getLogger("sononerf")
    before = talker.level
    talker.setLevel(logging.ERROR)
    try:
        return Scene(mesh)
    finally:
        talker.setLevel(before)


def _keep(path: Path, retrace: Retrace, surface: Surface) -> float:
    tensors = {
        "vertices": torch.as_tensor(np.array(retrace.mesh.vertices, dtype=np.float64)),
        "faces": torch.as_tensor(np.array(retrace.mesh.faces, dtype=np.int64)),
        "gain_db": torch.as_tensor(retrace.gain_db),
        "share": torch.tensor(retrace.share, dtype=torch.float64),
        "hull": torch.tensor(surface == "hull"),
    }
    data = safetensors.torch.save(tensors, metadata={"model": model_of(path)})
    storage.commit_bytes(path / NAME, data)
    return retrace.share


def load_retrace(path: Path) -> Retrace | None:
    """Read ``RUN/retrace.safetensors``; None where there is none, or it is of another fit.

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
            found = {name: opened.get_tensor(name) for name in opened.keys()}
            model = (opened.metadata() or {}).get("model")
        if model != model_of(path):
            return None
        faces, vertices = found["faces"].numpy(), found["vertices"].numpy()
        gain, share = found["gain_db"].numpy(), float(found["share"])
        if not (np.isfinite(vertices).all() and np.isfinite(gain).all() and 0 <= share <= 1):
            raise ValueError("numbers out of bounds")
        if len(faces) and not 0 <= int(faces.min()) <= int(faces.max()) < len(vertices):
            raise ValueError("a triangle names no vertex")
        return Retrace(trimesh.Trimesh(vertices, faces, process=False), gain, share)
    except (SafetensorError, KeyError, ValueError, OSError) as error:
        raise InputError(
            f"{file}: damaged ({error}); remove it, and `sononerf fit` makes it anew"
        ) from None
