# SPDX-License-Identifier: MIT
"""List of the installed scenes, and their pictures; copies of the templates of plugins."""

from __future__ import annotations

import inspect
import json
import logging
import re
import sys
from collections.abc import Callable, Iterator
from contextlib import contextmanager, redirect_stdout
from pathlib import Path
from typing import Any, Literal

from sononerf import storage
from sononerf.display import aligned
from sononerf.echoes.memory_ensemble import Ensemble
from sononerf.errors import InputError, SettingsError, SonoNerfError
from sononerf.head.front_end import compress
from sononerf.report.mesh_picture import mesh_png
from sononerf.report.scene_picture import echo_png, scene_png
from sononerf.run.simulate import scene_of, simulator_of
from sononerf.scene.scene import list_scenes, load_scene
from sononerf.settings import loading
from sononerf.settings.schema import Settings
from sononerf.simulation.simulator import pose_seed

PluginKind = Literal["scene", "field", "renderer"]
TEMPLATES = Path(__file__).resolve().parent.parent / "templates"
"""Folder of the packages, one per kind; each is called ``my-KIND``, its module ``my_KIND``."""


def new_plugin(kind: PluginKind, name: str, folder: Path | None = None) -> list[Path]:
    """Write a plugin with one scene, field or renderer: two files that install, and their test."""
    module = name.replace("-", "_")
    if not re.fullmatch(r"[A-Za-z]([A-Za-z0-9_-]*[A-Za-z0-9])?", name):
        raise SettingsError(
            f"NAME: found {name!r}; give letters, digits, _ and -, a letter first and no _ or - "
            "last, e.g. my_bar"
        )
    if any(plugin.name == module for plugin in loading.registered(f"sononerf.{kind}s")):
        raise SettingsError(f"NAME: there is a {kind} {module!r}; choose another, e.g. my_{module}")
    folder = Path(name) if folder is None else folder
    if folder.is_dir() and any(folder.iterdir()):
        raise SettingsError(f"{folder}: is not empty; choose another folder with --output")
    written = []
    for file in sorted((TEMPLATES / kind).glob("*.*"), key=lambda file: file.name):
        text = file.read_text(encoding="utf-8")
        text = text.replace(f"my-{kind}", name).replace(f"my_{kind}", module)
        written.append(folder / file.name.replace(f"my_{kind}", module))
        storage.commit_text(written[-1], text)
    return sorted(written, key=lambda file: (file.suffix != ".toml", file.name.startswith("test_")))


def describe_scenes() -> list[dict[str, Any]]:
    """Return the properties of every scene, built without options."""
    rows = []
    for plugin in list_scenes():
        row: dict[str, Any] = {
            "name": plugin.name,
            "distribution": plugin.distribution,
            "version": plugin.version,
            "broken": False,
            "options": [],
            "needs": [],
            "size_m": None,
            "triangles": None,
        }
        try:
            with _quietly():
                factory = loading.load(loading.SCENES, plugin.name)
                row["summary"] = (inspect.getdoc(factory) or "").partition("\n")[0]
                row["options"], row["needs"] = _options(factory)
                if not row["needs"]:
                    mesh = load_scene(plugin.name).mesh
                    row["size_m"] = [float(length) for length in mesh.extents]
                    row["triangles"] = len(mesh.faces)
        except SonoNerfError as error:
            row["summary"] = "broken: " + " ".join(str(error).split())
            row["broken"] = True
        rows.append(row)
    return rows


def scene_table(rows: list[dict[str, Any]]) -> list[str]:
    """Return the rows as lines of an aligned table under a head; sizes in millimetres."""
    table = [["name", "from", "size (mm)", "triangles", ""]]
    for row in rows:
        size = " x ".join(f"{1e3 * length:.4g}" for length in row["size_m"] or [])
        needs = f"needs {', '.join(row['needs'])}" if row["needs"] else "-"
        count = "-" if row["triangles"] is None else str(row["triangles"])
        origin = f"{row['distribution']} {row['version']}"
        table.append([row["name"], origin, size or needs, count, row["summary"]])
    return aligned(table, "<<<><")


def describe_scene(name: str) -> dict[str, Any]:
    """Return the description of one scene, with its options."""
    with _quietly():
        factory = loading.load(loading.SCENES, name)
        return {
            "name": name,
            "description": (inspect.getdoc(factory) or "").partition("\n\nReturns:\n")[0],
            "options": loading.describe_options(factory),
        }


def option_table(scene: dict[str, Any]) -> list[str]:
    """Return a scene's description and its options as lines."""
    table = [["scene.options.", "default", "allowed"]]
    for row in scene["options"]:
        default = "needed" if row["needed"] else _plain(row["default"])
        table.append([row["name"], default, row["allowed"]])
    return [*scene["description"].splitlines(), "", *aligned(table, "<<<")]


def _plain(value: object) -> str:
    return json.dumps(value) if isinstance(value, bool) else "none" if value is None else str(value)


def _options(factory: Callable[..., Any]) -> tuple[list[str], list[str]]:
    """Return the names of a factory's options, and of those that have no default."""
    try:
        given = inspect.signature(factory).parameters.values()
    except (TypeError, ValueError) as error:
        raise InputError(f"its arguments cannot be read: {error}") from None
    named = [p for p in given if p.kind not in (p.VAR_POSITIONAL, p.VAR_KEYWORD)]
    return [p.name for p in named], [p.name for p in named if p.default is p.empty]


@contextmanager
def _quietly() -> Iterator[None]:
    """Keep the output of factories, and warnings about their meshes, off ours."""

    def drop(record: logging.LogRecord) -> bool:
        del record
        return False

    logger = logging.getLogger("sononerf")
    logger.addFilter(drop)
    try:
        with redirect_stdout(sys.stderr):
            yield
    finally:
        logger.removeFilter(drop)


def draw_scenes(folder: Path) -> tuple[list[Path], list[str]]:
    """Draw every scene that needs no options."""
    storage.probe_writable(folder)
    written, skipped = [], []
    for plugin in list_scenes():
        try:
            with _quietly():
                needs = _options(loading.load(loading.SCENES, plugin.name))[1]
                picture = None if needs else mesh_png(load_scene(plugin.name).mesh)
        except SonoNerfError as error:
            skipped.append(f"{plugin.name}: " + " ".join(str(error).split()))
            continue
        if picture is None:
            skipped.append(f"{plugin.name}: needs scene.options.{', '.join(needs)}")
            continue
        path = folder / f"{plugin.name}.png"
        storage.commit_bytes(path, picture)
        written.append(path)
    return written, skipped


def draw_ensemble(settings: Settings, store: Ensemble, folder: Path) -> list[Path]:
    """Draw a scene with the poses of its ensemble, and the echo of the first test pose.

    Without test poses, the first pose is drawn.
    """
    with _quietly():  # who simulated it has been warned
        scene = scene_of(settings)
    name = "" if settings.scene is None else settings.scene.name
    written = [folder / "scene.png"]
    forward = store.rotations[:, :, 0]
    storage.commit_bytes(
        written[0], scene_png(scene.mesh, store.positions, forward, split=store.split)
    )
    index = int([*store.indices("test"), 0][0])
    written.append(folder / f"pose_{index:04d}.png")
    simulator = simulator_of(scene, settings)
    pose = store.positions[index], store.rotations[index]
    seed = pose_seed(settings.simulation.seed, index)
    points, level_db = simulator.hits(*pose)
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
        speed_of_sound=simulator.head.speed_of_sound,
        title=f"{name}, pose {index}",
    )
    storage.commit_bytes(written[1], picture)
    return written
