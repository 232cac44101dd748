# SPDX-License-Identifier: MIT
"""What is ensonified: a surface, and how it reflects."""

from __future__ import annotations

import logging
import math
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
import trimesh

from sononerf import plugins
from sononerf.errors import InputError, SonoNerfError

logger = logging.getLogger("sononerf")

LARGEST = 100.0  # m
SMALLEST = 1e-3  # m


@dataclass(frozen=True)
class Material:
    """How a surface reflects, at nodes over frequency.

    Between the nodes values run straight over the logarithm of frequency; beyond them they stay.
    The defaults are the specular ones of SonoTraceLab.

    Attributes
    ----------
    frequency : (K,) float, Hz
        Nodes, ascending.
    lobe_width : (K,) float, rad
        Standard deviation of the lobe about the mirror direction.
    strength : (K,) float, 1
        What is heard of a hit, relative to a mirror.
    reflection : (K,) float, 1
        What is kept of the pressure when the sound travels on after a bounce, 0 to 1.
    """

    frequency: tuple[float, ...] = (20e3, 150e3)
    lobe_width: tuple[float, ...] = (math.radians(12.0), math.radians(4.0))
    strength: tuple[float, ...] = (1.0, 0.7)
    reflection: tuple[float, ...] = (1.0, 0.7)

    def __post_init__(self) -> None:
        nodes = np.asarray(self.frequency, dtype=np.float64)
        if len(nodes) < 1 or not (nodes > 0.0).all() or not (np.diff(nodes) > 0.0).all():
            raise ValueError(f"material frequency is {self.frequency}, expected ascending nodes")
        for name, lowest, highest in (
            ("lobe_width", 1e-4, math.pi),
            ("strength", 0.0, math.inf),
            ("reflection", 0.0, 1.0),
        ):
            values = np.asarray(getattr(self, name), dtype=np.float64)
            if values.shape != nodes.shape:
                raise ValueError(
                    f"material {name} has {values.size} values, frequency {nodes.size}"
                )
            if not (np.isfinite(values) & (values >= lowest) & (values <= highest)).all():
                raise ValueError(f"material {name} is {values}, expected {lowest} to {highest}")


@dataclass(frozen=True, eq=False)
class Scene:
    """A surface and its material.

    Attributes
    ----------
    mesh : trimesh.Trimesh
        Metres, world frame; bodies may overlap.
    material : Material
        One for all of it.

    Raises
    ------
    InputError
        If the mesh has no triangles, a vertex that is no finite number, an index to no vertex,
        or a size that says its unit was mistaken.
    """

    mesh: trimesh.Trimesh
    material: Material = Material()

    def __post_init__(self) -> None:
        check_surface(self.mesh)
        _warn_of_faults(self.mesh)


def check_surface(mesh: trimesh.Trimesh) -> None:
    """Refuse a mesh that is no surface of a sensible size in metres.

    Raises
    ------
    InputError
        As :class:`Scene` says.
    """
    faces, vertices = np.asarray(mesh.faces), np.asarray(mesh.vertices)
    if len(faces) == 0:
        raise InputError("the mesh has no triangles; give a surface")
    if faces.min() < 0 or faces.max() >= len(vertices):
        raise InputError(f"a triangle of the mesh names no vertex ({len(vertices)} vertices)")
    bad = np.flatnonzero(~np.isfinite(vertices).all(axis=1))
    if len(bad):
        raise InputError(f"vertex {bad[0]} of the mesh is {vertices[bad[0]]}; mend the mesh")
    used = vertices[np.unique(faces)]
    size = float(np.ptp(used, axis=0).max())
    if not SMALLEST <= size <= LARGEST:
        hint = (
            "millimetres taken for metres? set the unit to mm"
            if size > LARGEST
            else "metres taken for millimetres? set the unit to m"
        )
        raise InputError(
            f"the mesh is {size:.3g} m large, expected {SMALLEST:g} to {LARGEST:g} m; {hint}"
        )


def _warn_of_faults(mesh: trimesh.Trimesh) -> None:
    if not mesh.is_watertight:
        _, uses = np.unique(np.sort(mesh.edges, axis=1), axis=0, return_counts=True)
        count = int((uses % 2).sum())
        what = f"{count} edges belong to one triangle alone" if count else "edges are shared oddly"
        logger.warning("the mesh is open (%s); volumes will not be measured", what)
    elif not mesh.is_winding_consistent:
        logger.warning("the mesh's triangles do not agree on which side is outside")
    elif mesh.volume < 0.0:
        logger.warning("the mesh is inside out; echoes do not mind, volumes do")


def list_scenes() -> list[plugins.Plugin]:
    """Return the registered scenes, sorted by name; imports none."""
    return plugins.registered(plugins.SCENES)


def load_scene(name: str, options: Mapping[str, Any] | None = None) -> Scene:
    """Build a scene by its name.

    Parameters
    ----------
    name : str
        Of an entry point of the group ``sononerf.scenes``.
    options : mapping
        Keyword arguments of its factory.

    Returns
    -------
    scene : Scene
        Checked.

    Raises
    ------
    SettingsError
        If the name is unknown or claimed twice, or an option is not allowed.
    InputError
        If the plugin cannot be imported, fails, or returns no scene.
    """
    factory = plugins.load(plugins.SCENES, name)
    arguments = plugins.check_options(factory, options or {}, where="scene.options")
    plugin = next(plugin for plugin in list_scenes() if plugin.name == name)
    owner = f"scene {name!r} of {plugin.distribution} {plugin.version}"
    try:
        scene = factory(**arguments)
    except SonoNerfError:
        raise  # says itself what is wrong, in one line
    except Exception as error:
        text = " ".join(str(error).split())
        raise InputError(f"{owner} failed: {type(error).__name__}: {text}") from error
    if not isinstance(scene, Scene):
        raise InputError(f"{owner} returned {type(scene).__name__}, expected a Scene")
    return scene
