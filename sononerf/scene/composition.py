# SPDX-License-Identifier: MIT
"""Scenes put together into one."""

from __future__ import annotations

import itertools
import logging
from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np
import trimesh
from numpy.typing import ArrayLike

from sononerf.errors import SettingsError
from sononerf.geometry.raycast import RayCaster
from sononerf.numerics import Bools, Floats, Ints
from sononerf.scene.material import Material
from sononerf.scene.scene import Scene

logger = logging.getLogger("sononerf")

LARGEST_SCALE = 1000.0
"""Largest scale: the ratio of the units m and mm."""
SQUARE = 1e-6
"""Largest deviation of the columns of a rotation from orthogonal unit vectors."""


@dataclass(frozen=True, eq=False)
class Part:
    """A scene and its place among others: scaled, then turned, then moved.

    Attributes:
        scene: Stays as it is.
        position ((3,), m): Place of its origin.
        rotation (3, 3): From its own frame to the world's.
        scale (1): Above 0, at most 1000.
        material: For all of it; its own where None.
        background: Whether all of it is surroundings and not the target.
        name: For messages; may be empty.
    """

    scene: Scene
    position: ArrayLike = (0.0, 0.0, 0.0)
    rotation: ArrayLike = field(default_factory=lambda: np.eye(3))
    scale: float = 1.0
    material: Material | None = None
    background: bool = False
    name: str = ""


def compose(parts: Sequence[Part], *, may_cross: bool = False) -> Scene:
    """Put scenes together into one.

    Args:
        may_cross: Whether it is meant that parts cut through one another. Otherwise it is warned
            of.
    """
    if not parts:
        raise SettingsError("parts: found none; give at least one")
    meshes = [_placed(part, f"parts.{number}") for number, part in enumerate(parts)]
    if not may_cross:
        _warn_of_crossings(parts, meshes)
    counts = [len(mesh.vertices) for mesh in meshes]
    firsts = np.cumsum([0, *counts[:-1]])
    mesh = trimesh.Trimesh(
        np.concatenate([mesh.vertices for mesh in meshes]),
        np.concatenate([mesh.faces + first for mesh, first in zip(meshes, firsts, strict=True)]),
        process=False,
        validate=False,
    )
    background = np.concatenate([_background(part) for part in parts])
    if background.all():
        raise SettingsError("parts: all are background; leave one that is the target")
    materials, of = _merged(parts)
    several = len(materials) > 1
    return Scene(
        mesh,
        materials if several else materials[0],
        of if several else None,
        background if background.any() else None,
    )


def _placed(part: Part, where: str) -> trimesh.Trimesh:
    rotation, position = np.asarray(part.rotation, float), np.asarray(part.position, float)
    if rotation.shape != (3, 3) or not np.isfinite(rotation).all():
        raise SettingsError(f"{where}.rotation: found no 3 by 3 finite numbers; give a matrix")
    if not np.abs(rotation.T @ rotation - np.eye(3)).max() <= SQUARE:
        raise SettingsError(
            f"{where}.rotation: found a matrix that is not orthonormal; its columns must be unit "
            "vectors square to one another"
        )
    if np.linalg.det(rotation) < 0.0:
        raise SettingsError(
            f"{where}.rotation: found a reflection, of determinant -1; a rotation has +1"
        )
    if not 0.0 < part.scale <= LARGEST_SCALE:
        raise SettingsError(
            f"{where}.scale: found {part.scale:g}; must lie above 0, at most {LARGEST_SCALE:g}"
        )
    if position.shape != (3,) or not np.isfinite(position).all():
        raise SettingsError(f"{where}.position: found no three finite numbers; give x, y, z in m")
    vertices = np.asarray(part.scene.mesh.vertices) * part.scale
    # Parts that are not turned keep their coordinates to the last bit.
    if not np.array_equal(rotation, np.eye(3)):
        vertices = vertices @ rotation.T
    faces = np.asarray(part.scene.mesh.faces)
    return trimesh.Trimesh(vertices + position, faces, process=False, validate=False)


def _background(part: Part) -> Bools:
    own = part.scene.background
    if part.background or own is None:
        return np.full(len(part.scene.mesh.faces), part.background)
    return own


def _merged(parts: Sequence[Part]) -> tuple[tuple[Material, ...], Ints]:
    """Return the materials of all parts, each once, and which one each triangle is of, (T,)."""
    numbers: dict[Material, int] = {}
    of = []
    for part in parts:
        scene, count = part.scene, len(part.scene.mesh.faces)
        own = scene.materials if part.material is None else (part.material,)
        which = np.zeros(count, np.int64)
        if part.material is None and scene.part is not None:
            which = scene.part
        # A material that no triangle is of is left out.
        used, which = np.unique(which, return_inverse=True)
        shared = [numbers.setdefault(own[index], len(numbers)) for index in used]
        of.append(np.asarray(shared, np.int64)[which])
    return tuple(numbers), np.concatenate(of)


def _warn_of_crossings(parts: Sequence[Part], meshes: Sequence[trimesh.Trimesh]) -> None:
    titles = [
        f"{number} ({part.name})" if part.name else str(number) for number, part in enumerate(parts)
    ]
    pairs = [
        f"{titles[one]} and {titles[other]}"
        for one, other in itertools.combinations(range(len(parts)), 2)
        if surfaces_cross(meshes[one], meshes[other])
    ]
    if pairs:
        logger.warning(
            "surfaces of parts cut through one another: %s; the union of the bodies is simulated, "
            "what lies inside another body is never heard",
            ", ".join(pairs),
        )


def surfaces_cross(one: trimesh.Trimesh, other: trimesh.Trimesh) -> bool:
    """Whether two surfaces cut through one another.

    Where triangles meet, an edge of one of them passes through the other; so all edges of each
    surface are tried against the other one.

    Returns:
        cross: False also where one lies wholly inside the other. Surfaces that touch may be taken
            for either, as single precision has it.
    """
    low = np.maximum(one.bounds[0], other.bounds[0])
    high = np.minimum(one.bounds[1], other.bounds[1])
    if (low > high).any():
        return False
    near = [_within(mesh, low, high) for mesh in (one, other)]
    if not all(len(mesh.faces) for mesh in near):
        return False
    return _pierces(near[0], near[1]) or _pierces(near[1], near[0])


def _within(mesh: trimesh.Trimesh, low: Floats, high: Floats) -> trimesh.Trimesh:
    """Return the triangles whose bounding boxes reach into a box."""
    vertices, faces = np.asarray(mesh.vertices), np.asarray(mesh.faces)
    corners = vertices[faces]
    overlaps = (corners.min(axis=1) <= high) & (corners.max(axis=1) >= low)
    return trimesh.Trimesh(vertices, faces[overlaps.all(axis=1)], process=False, validate=False)


def _pierces(edged: trimesh.Trimesh, faced: trimesh.Trimesh) -> bool:
    faces = np.asarray(edged.faces)
    ends = np.unique(np.sort(faces[:, [[0, 1], [1, 2], [2, 0]]].reshape(-1, 2), axis=1), axis=0)
    start, end = np.asarray(edged.vertices)[ends.T]
    return not RayCaster(faced).visible(start, end).all()
