# SPDX-License-Identifier: MIT
"""What scenes there are, and how they look."""

from __future__ import annotations

import inspect
from pathlib import Path
from typing import Any

from sononerf import plugins, storage
from sononerf.acoustics.spectrogram import compress
from sononerf.config import Settings
from sononerf.data.store import EnsembleStore
from sononerf.errors import SonoNerfError
from sononerf.render.echo import echo_png
from sononerf.render.mesh import mesh_png
from sononerf.render.scene import scene_png
from sononerf.scene import list_scenes, load_scene
from sononerf.simulation.ensemble import pose_seed
from sononerf.simulation.simulator import Simulator


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
    """Draw a scene with the poses of its ensemble, and the echo of the first test pose.

    The first pose of all where none is for the test.

    Parameters
    ----------
    settings : Settings
        Of the ensemble.
    store : EnsembleStore
        Complete.
    folder : Path
        Of the pictures.

    Returns
    -------
    written : list of Path
        ``scene.png`` and ``pose_0000.png``, numbered as in the store.

    Raises
    ------
    StorageError
        If a picture cannot be written.
    """
    scene = load_scene(settings.scene.name, settings.scene.options)
    written = [folder / "scene.png"]
    forward = store.rotations[:, :, 0]
    storage.commit_bytes(
        written[0], scene_png(scene.mesh, store.positions, forward, split=store.split)
    )
    index = int([*store.indices("test"), 0][0])
    written.append(folder / f"pose_{index:04d}.png")
    simulator = Simulator.from_settings(scene, settings)
    pose = store.positions[index], store.rotations[index]
    seed = pose_seed(settings.simulation.seed, index)
    points, level_db = simulator.hits(*pose, seed=seed)
    picture = echo_png(
        scene.mesh,
        points,
        level_db,
        *pose,
        simulator.receive(*pose, seed=seed)[0],
        settings.spectrogram.sampling_rate,
        compress(store.read_pose(index), store.attributes["reference"]),
        store.range,
        store.frequency,
        speed_of_sound=simulator.speed_of_sound,
        title=f"{settings.scene.name}, pose {index}",
    )
    storage.commit_bytes(written[1], picture)
    return written
