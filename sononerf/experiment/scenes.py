# SPDX-License-Identifier: MIT
"""What scenes there are, and how they look."""

from __future__ import annotations

import inspect
from pathlib import Path
from typing import Any

from sononerf import plugins, storage
from sononerf.config import Settings
from sononerf.data.store import EnsembleStore
from sononerf.errors import SonoNerfError
from sononerf.render.mesh import mesh_png
from sononerf.render.scene import scene_png
from sononerf.scene import list_scenes, load_scene


def describe_scenes() -> list[dict[str, Any]]:
    """Return name, origin and one line of every scene; a broken one says why it is broken."""
    rows = []
    for plugin in list_scenes():
        row = {
            "name": plugin.name,
            "distribution": plugin.distribution,
            "version": plugin.version,
            "broken": False,
            "options": [],
        }
        try:
            factory = plugins.load(plugins.SCENES, plugin.name)
            row["summary"] = (inspect.getdoc(factory) or "").partition("\n")[0]
            row["options"] = list(inspect.signature(factory).parameters)
        except SonoNerfError as error:
            row["summary"] = f"broken: {error}"
            row["broken"] = True
        rows.append(row)
    return rows


def draw_scenes(folder: Path) -> list[Path]:
    """Draw every scene that needs no options; return the files."""
    written = []
    for plugin in list_scenes():
        try:
            scene = load_scene(plugin.name)
        except SonoNerfError:
            continue  # listed as broken, or made from a file of the user's
        path = folder / f"{plugin.name}.png"
        storage.commit_bytes(path, mesh_png(scene.mesh))
        written.append(path)
    return written


def draw_ensemble(settings: Settings, store: EnsembleStore, folder: Path) -> list[Path]:
    """Draw a scene with the poses of its ensemble; return the files."""
    scene = load_scene(settings.scene.name, settings.scene.options)
    path = folder / "scene.png"
    storage.commit_bytes(path, scene_png(scene.mesh, store.positions, store.rotations[:, :, 0]))
    return [path]
