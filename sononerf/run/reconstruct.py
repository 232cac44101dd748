# SPDX-License-Identifier: MIT
"""Reconstruct a run's surface: make it of the echoes, and refine it."""

from __future__ import annotations

import hashlib
import itertools
import logging
import math
import time
from collections.abc import Iterator, MutableMapping
from pathlib import Path
from typing import Literal

import numpy as np
import safetensors.torch
import trimesh
from safetensors import SafetensorError, safe_open
from torch import Tensor

from sononerf import __version__, storage
from sononerf.callbacks import add_mesh, writing
from sononerf.errors import InputError, SettingsError
from sononerf.field.checkpoint_io import model_checksum
from sononerf.geometry.lattice import vti_bytes
from sononerf.geometry.poses import Frame
from sononerf.progress import Progress
from sononerf.refinement import descent, reconstruction
from sononerf.refinement.reconstruction import refine, starts_of
from sononerf.refinement.surface_error import error_from_twice
from sononerf.report.mesh_picture import confidence_png, mesh_png, side_by_side_png
from sononerf.report.mip_picture import mip_pictures
from sononerf.run.build import results_folder, true_mesh
from sononerf.run.run import Run
from sononerf.start.surface import FORMATS, Surface, mesh_bytes

logger = logging.getLogger("sononerf")

STAGES = Path("checkpoints") / "surface"
"""Where the stages of an unfinished refinement are kept, in the run's folder."""


class SavedStages(MutableMapping[str, dict[str, Tensor]]):
    """Stages of a refinement, one file each."""

    def __init__(self, folder: Path, belongs: str) -> None:
        self.folder, self._belongs = folder, {"of": belongs}
        for key in self:
            if self._metadata(key) != self._belongs:
                del self[key]

    def _file(self, key: str) -> Path:
        return self.folder / f"{key}.safetensors"

    def _metadata(self, key: str) -> dict[str, str] | None:
        try:
            with safe_open(str(self._file(key)), "pt") as opened:
                return dict(opened.metadata() or {})
        except (SafetensorError, OSError):
            return None

    def __getitem__(self, key: str) -> dict[str, Tensor]:
        if not self._file(key).is_file():
            raise KeyError(key)
        return safetensors.torch.load_file(self._file(key))

    def __setitem__(self, key: str, stage: dict[str, Tensor]) -> None:
        own = {name: part.cpu().clone().contiguous() for name, part in stage.items()}
        data = safetensors.torch.save(own, metadata=self._belongs)
        storage.commit_bytes(self._file(key), data)

    def __delitem__(self, key: str) -> None:
        storage.remove_file(self._file(key))

    def __iter__(self) -> Iterator[str]:
        return iter(sorted(file.stem for file in self.folder.glob("*.safetensors")))

    def __len__(self) -> int:
        return len(list(iter(self)))


def refine_surface(
    run: Run, surface: Surface, *, accelerator: str = "auto", progress: Progress
) -> Surface:
    """Refine the surface of a run; stages that an interrupted refinement finished are kept."""
    settings = run.settings
    places = b"".join(mesh.vertices.tobytes() for mesh in starts_of(surface).values())
    state = f"{model_checksum(run.path)} {__version__} {descent.STAGES}".encode()
    saved = SavedStages(run.path / STAGES, hashlib.sha256(places + state).hexdigest())
    numbers = itertools.count(1)

    def after_stage(mesh: trimesh.Trimesh, error_db: float) -> None:
        number = next(numbers)
        with writing(run.path) as writer:
            add_mesh(writer, "mesh/refinement_stages", mesh, number)
            writer.add_scalar("refinement/validation_error_dB", error_db, number)

    refined = refine(
        surface,
        run.echoes,
        options=settings.simulation,
        seed=settings.fit.seed,
        accelerator=accelerator,
        saved=saved,
        after_stage=after_stage,
        progress=progress,
    )
    saved.clear()
    return refined


def reconstruct(
    run: Path | Run,
    *,
    spacing: float | None = None,
    level: float | Literal["auto"] | None = None,
    method: Literal["levels", "isosurface"] | None = None,
    refine: bool | None = None,
    output: Path | None = None,
    accelerator: str = "auto",
    progress: Progress | None = None,
) -> Path:
    """Write mesh, volume, projections and a view.

    The surface is made of the echoes that the field was fitted to, and refined against them. An
    iso-surface is read out of the field alone, and is not refined.

    Args:
        run: A fitted run.
        spacing (m): Voxel size; the settings' by default.
        level ("auto" or None): A number asks for an iso-surface of this level; the settings' where
            None.
        method: Method of the surface; that of the settings by default.
        refine: Whether to refine the surface; as the settings say by default.
        output: Folder of the results; ``RUN/reconstruction`` by default.
        accelerator: Device that refines the surface.
        progress: Display of progress.

    Raises:
        NumericalError: If there is no surface.
    """
    progress = progress or Progress(quiet=True)
    run = Run.of(run)
    started = time.monotonic()
    options = run.settings.reconstruction
    folder = output or run.reconstruction
    own = folder.resolve() == run.reconstruction.resolve()
    # Arguments of the caller replace both settings.
    if method is None:
        method = options.method if level in (None, "auto") else "isosurface"
    if level is None:
        level = options.level if method == "isosurface" else "auto"
    if level != "auto" and method != "isosurface":
        raise SettingsError(f"method {method} has no level; leave out one of the two")
    if refine and method == "isosurface":
        raise SettingsError("an iso-surface is not refined; leave out --refine, or take levels")
    if method != "isosurface" and not _has_echoes(run, progress):
        method = "isosurface"
    refines = (options.refine if refine is None else refine) and method != "isosurface"
    chosen = options.model_copy(
        update={"method": method, "level": level, "spacing": spacing or options.spacing}
    )
    with run.locked(None if refines else folder), results_folder(folder):
        truth = _truth(run)
        heard = None if method == "isosurface" else run.echoes
        surface = reconstruction.reconstruct(run.model, heard, options=chosen, progress=progress)
        if refines:
            surface = refine_surface(run, surface, accelerator=accelerator, progress=progress)
        if own:
            run.begin("surface")
        _write(folder, surface, truth, run.frame())
        if output is None:
            run.write_metrics("cost", {"reconstruct_s": time.monotonic() - started}, merge=True)
    return folder


def _has_echoes(run: Run, progress: Progress) -> bool:
    """Return True if the run's echoes can be opened; report it if they cannot."""
    try:
        return run.echoes is not None
    except InputError as error:
        progress.say(f"an iso-surface is taken, because the surface needs the echoes: {error}")
        return False


def _truth(run: Run) -> trimesh.Trimesh | None:
    """Return the true surface, for the view; None, with a warning, where it cannot be read."""
    try:
        return true_mesh(run.settings, run.provenance)
    except InputError as error:
        logger.warning("the view shows no true surface: %s", error)
        return None


def _write(folder: Path, surface: Surface, truth: trimesh.Trimesh | None, frame: Frame) -> None:
    mesh, seen = surface.mesh, surface.confidence
    assert surface.volume is not None  # it was read out of a field
    for kind in FORMATS:
        storage.commit_bytes(folder / f"mesh.{kind}", surface.file(kind))
        if not frame.is_world:
            data = mesh_bytes(frame.mesh(mesh), kind, confidence=seen, error=surface.error)
            storage.commit_bytes(folder / f"mesh_original.{kind}", data)
    if seen is not None:
        storage.commit_bytes(folder / "confidence.png", confidence_png(mesh, seen))
    storage.commit_bytes(folder / "volume.vti", vti_bytes(surface.volume))
    for axis, picture in mip_pictures(surface.volume).items():
        storage.commit_bytes(folder / f"mip_{axis}.png", picture)
    view = mesh_png(mesh) if truth is None else side_by_side_png(truth, mesh)
    storage.commit_bytes(folder / "view.png", view)
    # Last: a reconstruction without this file is not complete.
    storage.commit_json(
        folder / "read_out.json",
        {
            "method": surface.method,
            "level": surface.level,
            "spacing_m": surface.volume.spacing,
            "surface": None if surface.openness is None else surface.openness.kind,
            "refined": surface.refined,
            "validation_error_db": surface.error_db,
            **_errors(surface),
            "faults": list(surface.faults),
        },
    )


def _errors(surface: Surface) -> dict[str, float | None]:
    """Return the median error of what was heard, m, and that from twice as many poses."""
    names = "median_error_m", "median_error_from_twice_m"
    heard = surface.confidence is not None and surface.confidence > 0
    if surface.error is None or surface.echoes is None or not np.any(heard):
        return dict.fromkeys(names)
    median = float(np.median(surface.error[heard]))
    if not 0.0 < median < math.inf:
        return dict.fromkeys(names)
    twice = error_from_twice(median, surface.echoes.head.wavelength)
    return dict(zip(names, (median, twice), strict=True))
