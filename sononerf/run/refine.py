# SPDX-License-Identifier: MIT
"""Refine a run's surface against the echoes that it was fitted to; interruptible and resumable."""

from __future__ import annotations

import hashlib
import time
from collections.abc import Mapping
from functools import partial
from pathlib import Path

import safetensors.torch
import torch
import trimesh
from safetensors import SafetensorError, safe_open

from sononerf import storage
from sononerf.field.weights import model_checksum
from sononerf.head.head import Head
from sononerf.progress import Progress
from sononerf.run.fit import require_accelerator
from sononerf.run.fitted import Fitted, store_of
from sononerf.settings.schema import SimulationSettings
from sononerf.simulation.simulator import Simulator
from sononerf.surface.refine.echo_data import Echoes
from sononerf.surface.refine.later_bounces import quiet_scene
from sononerf.surface.refine.optics import Optics
from sononerf.surface.refine.refinement import Refined, Refinement

STATE = Path("checkpoints") / "surface.safetensors"
"""Where a refinement that was interrupted goes on, in the run's folder."""
RAYS = 20_000
"""Per pose, for the correction of the last stage."""


def refine_surface(
    path: Path,
    fitted: Fitted,
    starts: Mapping[str, trimesh.Trimesh],
    *,
    accelerator: str = "auto",
    progress: Progress,
) -> Refined:
    """Refine a surface; the same call goes on where an interrupted one stopped.

    Parameters
    ----------
    path : Path
        The run's folder; the state is kept there until the refinement is done.
    fitted : Fitted
        The run.
    starts : mapping of str to Trimesh
        Surfaces to start from, m, by the method that they were read out by.
    accelerator : {"auto", "cpu", "gpu"}
        What to compute on.
    progress : Progress
        Where to show it.

    Raises
    ------
    InputError, IncompatibleError
        If the run's echoes are not there, or are others.
    ResourceError
        If ``gpu`` was asked for and there is none.
    """
    require_accelerator(accelerator)
    settings = fitted.settings
    store = store_of(fitted)
    optics = Optics(fitted.head).to(_device(accelerator))
    work = Refinement(
        starts,
        Echoes.of(store),
        optics,
        hull=fitted.hull,
        simulate=partial(surface_simulator, fitted.head, settings.simulation, rays=RAYS),
        seed=settings.fit.seed,
        # The level of a recording is that of its microphone and its amplifier.
        calibrated=store.attributes.get("origin") == "simulated",
    )
    digest = hashlib.sha256(b"".join(mesh.vertices.tobytes() for mesh in starts.values()))
    identity = f"{model_checksum(path)} {digest.hexdigest()}"
    file = path / STATE
    _restore(file, work, identity)
    saved = time.monotonic()
    with progress.task("refining", work.total) as task:
        task.advance(work.drawn)
        while not work.done:
            mismatch = work.advance()
            task.advance(work.drawn - task.done, f"mismatch {mismatch:.2f} dB")
            if time.monotonic() - saved > settings.fit.checkpoint_seconds and not work.done:
                _save(file, work, identity)
                saved = time.monotonic()
    refined = work.result()
    storage.remove_file(file)
    return refined


def surface_simulator(
    head: Head, options: SimulationSettings, mesh: trimesh.Trimesh, *, rays: int
) -> Simulator:
    """Return the default engine on a surface, with a number of rays and without noise."""
    wanted = options.model_copy(update={"engine": "hybrid", "rays": rays})
    return Simulator.of(quiet_scene(mesh), head.without_noise(), wanted)


def _device(accelerator: str) -> torch.device:
    """Return the device that Lightning would take for the accelerator."""
    if accelerator != "cpu" and torch.cuda.is_available():
        return torch.device("cuda")
    return torch.device("cpu")


def _save(file: Path, work: Refinement, identity: str) -> None:
    tensors = {name: part.cpu().clone().contiguous() for name, part in work.state().items()}
    storage.commit_bytes(file, safetensors.torch.save(tensors, metadata={"of": identity}))


def _restore(file: Path, work: Refinement, identity: str) -> None:
    """Take up the state of an interrupted refinement of the same start; ignore any other."""
    try:
        with safe_open(str(file), "pt") as opened:
            if (opened.metadata() or {}).get("of") != identity:
                return
            work.load({name: opened.get_tensor(name) for name in opened.keys()})
    except (SafetensorError, OSError, KeyError, ValueError):
        return  # the state only saves time; the refinement starts from the beginning
