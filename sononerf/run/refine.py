# SPDX-License-Identifier: MIT
"""Refine a run's surface; an interrupted refinement goes on from its saved state."""

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
from torch import Tensor

from sononerf import storage
from sononerf.errors import IncompatibleError
from sononerf.field.checkpoint_io import model_checksum
from sononerf.field.fitting import require_accelerator
from sononerf.progress import Progress
from sononerf.run.run_folder import RunFolder
from sononerf.simulation.simulator import Simulator
from sononerf.surface.refine import descent as stages
from sononerf.surface.refine.optics import Optics
from sononerf.surface.refine.refinement import (
    STATE_VERSION,
    Refined,
    Refinement,
    number_of_steps,
    refine,
)
from sononerf.surface.start.read_out import StartMethod

STATE = Path("checkpoints") / "surface.safetensors"
"""Where the state of an interrupted refinement is kept, in the run's folder."""
RAYS = 20_000
"""Rays per pose, for the correction of the last stage."""


def refine_surface(
    run: RunFolder,
    starts: Mapping[StartMethod, trimesh.Trimesh],
    *,
    accelerator: str = "auto",
    progress: Progress,
) -> Refined:
    """Refine start surfaces of a run, or go on where an interrupted refinement stopped.

    Args:
        run: Keeps the state until the refinement is done.
        starts: Start surfaces, m, by their method.
        accelerator: What to compute on.
        progress: Where to show it.

    Raises:
        InputError, IncompatibleError: If the run's echoes are not there, or are others.
        ResourceError: If ``gpu`` was asked for and there is none.
    """
    require_accelerator(accelerator)
    settings, head = run.fitted.settings, run.fitted.head
    digest = hashlib.sha256(b"".join(mesh.vertices.tobytes() for mesh in starts.values()))
    belongs = {**_version(), "of": f"{model_checksum(run.path)} {digest.hexdigest()}"}
    file = run.path / STATE
    saved = time.monotonic()
    with progress.task("refining", number_of_steps(starts)) as task:

        def after_step(work: Refinement, mismatch: float) -> None:
            nonlocal saved
            task.advance(work.drawn - task.done, f"mismatch {mismatch:.2f} dB")
            if time.monotonic() - saved > settings.fit.checkpoint_seconds and not work.done:
                tensors = {name: p.cpu().clone().contiguous() for name, p in work.state().items()}
                data = safetensors.torch.save(tensors, metadata=belongs)
                storage.commit_bytes(file, data)
                saved = time.monotonic()

        refined = refine(
            starts,
            run.echoes,
            optics=Optics(head).to(_device(accelerator)),
            simulate=partial(
                Simulator.of_surface, head=head, options=settings.simulation, rays=RAYS
            ),
            seed=settings.fit.seed,
            state=_saved_state(file, belongs),
            after_step=after_step,
        )
    storage.remove_file(file)
    return refined


def check_state(run: RunFolder) -> None:
    """Refuse the state of a refinement that went through other stages than those of this version.

    Raises:
        IncompatibleError: If such a state is in the run.
    """
    file = run.path / STATE
    found = _metadata(file)
    if found is not None and any(found.get(key) != value for key, value in _version().items()):
        raise IncompatibleError(
            f"{file}: the refinement was interrupted in another version of sononerf; finish it "
            "with that version, or remove this file to refine from the beginning"
        )


def _version() -> dict[str, str]:
    return {"version": str(STATE_VERSION), "stages": repr(stages.STAGES)}


def _device(accelerator: str) -> torch.device:
    """Return the device that Lightning would take for the accelerator."""
    if accelerator != "cpu" and torch.cuda.is_available():
        return torch.device("cuda")
    return torch.device("cpu")


def _metadata(file: Path) -> dict[str, str] | None:
    """Return what a state says of itself; None where there is none, or it is damaged."""
    try:
        with safe_open(str(file), "pt") as opened:
            return opened.metadata() or {}
    except (SafetensorError, OSError):
        return None  # without a state the refinement starts from the beginning


def _saved_state(file: Path, belongs: dict[str, str]) -> dict[str, Tensor] | None:
    """Return the state of an interrupted refinement of the same starts, or None."""
    if _metadata(file) != belongs:
        return None
    with safe_open(str(file), "pt") as opened:
        return {name: opened.get_tensor(name) for name in opened.keys()}
