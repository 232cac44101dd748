# SPDX-License-Identifier: MIT
"""Scenes: surfaces, materials, checks of poses, and bodies that are put together."""

from __future__ import annotations

import itertools
import logging
from collections.abc import Callable, Mapping, Sequence
from dataclasses import InitVar, dataclass, field
from pathlib import Path
from typing import Any, Literal

import numpy as np
import trimesh
from numpy.typing import ArrayLike

from sononerf.display import NotebookRepr
from sononerf.errors import InputError, NumericalError, SettingsError, expect
from sononerf.geometry.meshes import Plane, surface_faults
from sononerf.geometry.poses import Poses, aim_fault
from sononerf.geometry.raycast import RayCaster, contains
from sononerf.numerics import Bools, Floats, Ints
from sononerf.scene.material import MATERIALS, RIGID, Material, MaterialName
from sononerf.settings import loading
from sononerf.settings.loading import faults_of

__all__ = [
    "MATERIALS",
    "Material",
    "MaterialName",
    "Scene",
    "SurfaceSizeError",
    "check_surface",
    "list_scenes",
    "load_scene",
]

logger = logging.getLogger("sononerf")

LARGEST = 100.0  # m
SMALLEST = 1e-3  # m
LARGE, SMALL = 5.0, 5e-3  # m, beyond which a mistaken unit is likelier than such a scene


class SurfaceSizeError(InputError):
    """A surface far larger or smaller than any scene. In: size (m)."""

    def __init__(self, size: float) -> None:
        super().__init__(f"the mesh is {size:.3g} m large, expected {SMALLEST:g} to {LARGEST:g} m")
        self.is_too_large = size > LARGEST


@dataclass(frozen=True, eq=False)
class Scene(NotebookRepr):
    """A surface and its material.

    Args:
        warns: False leaves out warnings about the mesh, such as holes in it.

    Attributes:
        mesh: Metres, world frame; bodies may overlap.
        material: One for all of it, or one for each of its parts.
        part (T,): Index of each triangle's material, if there are several.
        background (T,): True for triangles of the surroundings, which sound too but are not the
            target.
        to_original (4, 4): From the scene's frame, m, to the frame and unit of the file that it was
            read from; None where it was not read from a file.

    Raises:
        InputError: If materials, parts or background do not fit, nothing is left to be the target,
            or the mesh has no triangles, a vertex that is not finite, or an index to no vertex.
        SurfaceSizeError: If it is far too large or too small.
    """

    mesh: trimesh.Trimesh
    material: Material | tuple[Material, ...] = RIGID
    part: Ints | None = None
    background: Bools | None = None
    to_original: Floats | None = None
    warns: InitVar[bool] = True

    def __post_init__(self, warns: bool) -> None:
        expect(self.mesh, trimesh.Trimesh, "mesh")
        several = isinstance(self.material, tuple)
        if several != (self.part is not None):
            raise InputError("several materials and the parts they are of are given together")
        if self.part is not None:
            part = np.asarray(self.part)
            if part.shape != (len(self.mesh.faces),):
                raise InputError(
                    f"part has shape {part.shape}, expected one number for each of the "
                    f"{len(self.mesh.faces)} triangles"
                )
            if part.dtype.kind not in "iu" or part.min() < 0 or part.max() >= len(self.materials):
                raise InputError(f"part names no material, expected 0 to {len(self.materials) - 1}")
            object.__setattr__(self, "part", part.astype(np.int64))
        if self.background is not None:
            object.__setattr__(self, "background", self._checked(self.background))
        check_surface(self.mesh)
        if warns:
            _warn_of_faults(self.mesh)

    def _checked(self, background: Bools) -> Bools:
        background = np.asarray(background)
        if background.shape != (len(self.mesh.faces),) or background.dtype != np.bool_:
            raise InputError(
                f"background is {background.dtype} of shape {background.shape}, expected one bool "
                f"for each of the {len(self.mesh.faces)} triangles"
            )
        if len(background) and background.all():
            raise InputError("all triangles are background; leave the target out of it")
        return background

    @property
    def materials(self) -> tuple[Material, ...]:
        """All materials; ``part`` holds indices of them."""
        return self.material if isinstance(self.material, tuple) else (self.material,)

    @classmethod
    def load(
        cls, path: Path | str, *, unit: Literal["m", "cm", "mm"] | None = None, **options: Any
    ) -> Scene:
        """Load a surface from a file: STL, PLY, OBJ, OFF, GLB or glTF.

        The middle of its bounding box moves to the origin, which poses look at.

        Args:
            path: The file.
            unit: Unit of its numbers. GLB and glTF are in metres; for others it must be given.
            options: Others of the scene ``mesh``: ``scale``, ``centre``, ``material``,
                ``materials``; ``sononerf scenes mesh`` explains them.

        Raises:
            InputError: If the file cannot be read, is damaged, or holds no surface.
            SettingsError: If an option is not allowed.
        """
        return load_scene("mesh", {"path": str(path), "unit": unit, **options})

    def surface(self, *, background: bool) -> trimesh.Trimesh | None:
        """Return the surroundings alone, or the target alone; None if there is none of it."""
        faces = np.asarray(self.mesh.faces)
        marked = np.zeros(len(faces), bool) if self.background is None else self.background
        faces = faces[marked == background]
        if not len(faces):
            return None
        alone = trimesh.Trimesh(self.mesh.vertices, faces, process=False)
        alone.remove_unreferenced_vertices()
        return alone

    def with_image(self, plane: Plane) -> Scene:
        """Return the part above a plane together with its image.

        Raises:
            InputError: If nothing is above it, or the scene has several materials and reaches below
                the plane.
        """
        mesh, kept = plane.with_image(self.mesh)
        if self.part is None:
            return Scene(mesh, self.material, warns=False)
        if kept is None:
            raise InputError(
                "the scene reaches below its support and has several materials; cut it at the "
                "support, or give it one material"
            )
        part = np.concatenate([self.part[kept], self.part[kept]])
        return Scene(mesh, self.material, part, warns=False)

    def surroundings(self) -> Scene | None:
        """Return the background as a scene of its own; None if there is none."""
        mesh = self.surface(background=True)
        if mesh is None or self.background is None:
            return None
        part = None if self.part is None else self.part[self.background]
        return Scene(mesh, self.material, part, warns=False)


def check_surface(mesh: trimesh.Trimesh) -> None:
    """Refuse a mesh that is not a surface of a sensible size in metres."""
    faces, vertices = np.asarray(mesh.faces), np.asarray(mesh.vertices)
    if len(faces) == 0:
        raise InputError("the mesh has no triangles; give a surface")
    if faces.min() < 0 or faces.max() >= len(vertices):
        raise InputError(f"a triangle of the mesh names no vertex ({len(vertices)} vertices)")
    bad = np.flatnonzero(~np.isfinite(vertices).all(axis=1))
    if len(bad):
        raise InputError(f"vertex {bad[0]} of the mesh is {vertices[bad[0]]}; mend the mesh")
    size = _size(mesh)
    if not SMALLEST <= size <= LARGEST:
        raise SurfaceSizeError(size)
    if not (mesh.area_faces > 0).any():
        raise InputError("no triangle of the mesh has an area; give a surface")


def _size(mesh: trimesh.Trimesh) -> float:
    used = np.zeros(len(mesh.vertices), dtype=bool)
    used[np.asarray(mesh.faces)] = True
    return float(np.ptp(np.asarray(mesh.vertices)[used], axis=0).max())


def _warn_of_faults(mesh: trimesh.Trimesh) -> None:
    size = _size(mesh)
    if size > LARGE:
        logger.warning(
            "the mesh is %.3g m large; were millimetres taken for metres? It would be %.3g mm",
            *(size, size),
        )
    elif size < SMALL:
        logger.warning(
            "the mesh is %.3g mm large; were metres taken for millimetres? It would be %.3g m",
            *(1e3 * size, 1e3 * size),
        )
    for line in surface_faults(mesh):
        logger.warning("%s", line)


def list_scenes() -> list[loading.Plugin]:
    """Return the registered scenes, sorted by name; imports none."""
    return loading.registered(loading.SCENES)


def load_scene(
    name: str, options: Mapping[str, Any] | None = None, *, source: str | None = None
) -> Scene:
    """Build a scene by its name."""
    with faults_of(source):
        factory = loading.load(loading.SCENES, name)
        plugin = next(plugin for plugin in list_scenes() if plugin.name == name)
        owner = f"scene {name!r} of {plugin.distribution} {plugin.version}"
        try:
            arguments = loading.check_options(factory, options or {}, where="scene.options")
        except InputError as error:
            raise InputError(f"{owner}: {error}") from None
        try:
            return _built(owner, factory, arguments)
        except SurfaceSizeError as error:
            if options:
                raise SettingsError(f"scene.options: {error}") from None
            raise InputError(f"{owner}: {error}") from None
        except InputError as error:
            # Built-in scenes name the file that they read; other scenes have to add details
            # themselves.
            if plugin.distribution == "sononerf" or str(error).startswith(owner):
                raise
            raise InputError(f"{owner}: {error}") from None


def _built(owner: str, factory: Callable[..., Any], arguments: dict[str, Any]) -> Scene:
    scene = loading.call(owner, factory, **arguments)
    if not isinstance(scene, Scene):
        raise InputError(f"{owner} returned {type(scene).__name__}, expected a Scene")
    return scene


def check_positions(
    scene: Scene, poses: Poses, *, offsets: Floats | None = None, plane: Plane | None = None
) -> None:
    """Refuse poses that lie inside the surface, or not above the support.

    In: offsets ((K, 3), m).
    """
    points = np.zeros((1, 3)) if offsets is None else np.vstack([np.zeros((1, 3)), offsets])
    places = poses.positions[:, None] + np.einsum("pij,kj->pki", poses.rotations, points)
    mesh = scene.mesh
    faces = mesh.faces[:, ::-1] if mesh.volume < 0.0 else mesh.faces  # inside out
    inside = contains(mesh.vertices, faces, places.reshape(-1, 3)).reshape(places.shape[:2])
    _refuse(inside.any(axis=1), "inside the scene's surface")
    if plane is not None and (low := (plane.height(places) <= 0.0).any(axis=1)).any():
        raise InputError(
            f"{_named(low)} not above the support; move them, for example by "
            "poses.arrangement=cap, or move support.point"
        )


def _refuse(bad: ArrayLike, what: str) -> None:
    bad = np.asarray(bad)
    if bad.any():
        raise InputError(f"{_named(bad)} {what}; move them, or raise poses.radius")


def _named(bad: Bools) -> str:
    """Say how many poses there are of a kind, and which are the first ten."""
    indices = np.flatnonzero(bad)
    listed = ", ".join(str(index) for index in indices[:10])
    return (
        f"{len(indices)} of {len(bad)} poses ({listed}{', ...' if len(indices) > 10 else ''}) are"
    )


def check_reach(
    scene: Scene, poses: Poses, *, bounces: int, range_min: float, range_max: float
) -> None:
    """Warn of poses that no echo can reach within the range limits.

    In: range_min, range_max (m).
    """
    lower, upper = np.asarray(scene.mesh.bounds)
    radius = float(np.linalg.norm(upper - lower)) / 2.0
    nearest = np.linalg.norm(poses.positions - np.clip(poses.positions, lower, upper), axis=1)
    distance = np.linalg.norm(poses.positions - (lower + upper) / 2.0, axis=1)
    far, near = nearest > range_max, distance + bounces * radius < range_min
    if (far | near).all():
        raise NumericalError(deaf(range_min, range_max))
    for bad, what, limit in (
        (far, "farther from the scene than range_max", range_max),
        (near, "nearer to all of the scene than range_min", range_min),
    ):
        if bad.any():
            logger.warning(
                "%s %s (%g m) and will hear nothing; set spectrogram.range_%s, or move them",
                *(_named(bad), what, limit, "max" if bad is far else "min"),
            )


def check_aim(scene: Scene, poses: Poses, *, is_directional: bool) -> None:
    """Warn of poses that look away from the scene, and of poses that are all the same."""
    fault = aim_fault(poses, np.asarray(scene.mesh.bounds).mean(axis=0))
    if fault and is_directional:
        logger.warning("%s", fault)
    if len(poses) > 1 and not np.ptp(poses.positions, axis=0).any():
        logger.warning("all %d poses are at one place; check the table of poses", len(poses))


def deaf(range_min: float, range_max: float) -> str:
    """Say that no pose hears anything within the range limits."""
    return (
        f"no pose received an echo between {range_min} and {range_max} m; check poses.radius, "
        "the scene's size (of a file, its unit) and the range limits"
    )


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
        material: For all of it; its own by default.
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
