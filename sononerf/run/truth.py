# SPDX-License-Identifier: MIT
"""The true surface of a run, where one is known; it serves the metrics alone."""

from __future__ import annotations

import logging
from pathlib import Path

import numpy as np
import trimesh

from sononerf.errors import InputError, SonoNerfError
from sononerf.scene.scene import Scene, load_scene
from sononerf.settings.schema import Settings

logger = logging.getLogger("sononerf")

MOST_BYTES = 2_000_000_000
"""A larger file is refused before it is read."""
KINDS = (".ply", ".stl", ".obj", ".off", ".glb")


def true_scene(settings: Settings) -> Scene | None:
    """Return the scene of a run; None without one, and with a warning if it cannot be loaded."""
    if settings.scene is None:
        return None
    try:
        return load_scene(settings.scene.name, settings.scene.options)
    except SonoNerfError as error:
        logger.warning(
            "the true surface is unknown: %s; evaluation.truth=FILE names another file of it", error
        )
        return None


def true_mesh(settings: Settings) -> trimesh.Trimesh | None:
    """Return ``evaluation.truth``, or else the scene's own surface; None where neither is known.

    Raises:
        InputError: If the file of ``evaluation.truth`` is no mesh.
    """
    if settings.evaluation.truth is not None:
        return read_truth(settings.evaluation.truth)
    scene = true_scene(settings)
    return None if scene is None else scene.mesh


def read_truth(path: Path) -> trimesh.Trimesh:
    """Read a true surface from a file.

    Raises:
        InputError: If it is missing, of another kind, damaged, empty or not finite.
    """
    if path.suffix.lower() not in KINDS:
        raise InputError(f"{path}: evaluation.truth: expected one of {', '.join(KINDS)}")
    if not path.is_file():
        raise InputError(f"{path}: evaluation.truth: no such file")
    if path.stat().st_size > MOST_BYTES:
        raise InputError(f"{path}: evaluation.truth: larger than {MOST_BYTES} bytes")
    try:
        mesh = trimesh.load_mesh(path)
        if isinstance(mesh, trimesh.Scene):
            mesh = mesh.to_mesh()
        good = isinstance(mesh, trimesh.Trimesh) and len(mesh.faces) > 0
        good = good and bool(np.isfinite(mesh.vertices).all())
    except Exception as error:  # trimesh's readers raise whatever they met first
        raise InputError(f"{path}: evaluation.truth: damaged ({error})") from error
    if not good:
        raise InputError(f"{path}: evaluation.truth: holds no surface of finite triangles")
    return mesh
