# SPDX-License-Identifier: MIT
"""Poses: place and orientation of the head.

World frame: metres, right-handed, z up. Head frame: x forward, y left, z up. A rotation takes
head to world, ``R = Rz(yaw) Ry(pitch) Rx(roll)``, so positive pitch looks *down*.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Literal

import numpy as np
import trimesh
from numpy.typing import ArrayLike, NDArray

from sononerf.display import NotebookRepr, number_in, read_rows
from sononerf.errors import InputError
from sononerf.geometry.directions import fibonacci_cap, fibonacci_sphere
from sononerf.numerics import Floats

ORTHOGONAL = 1e-3
"""Largest deviation of a rotation's product with its transpose from the identity, no unit: that of
a table with four decimals."""
CSV_COLUMNS = ("x", "y", "z", "yaw", "pitch", "roll")


@dataclass(frozen=True, eq=False)
class Poses(NotebookRepr):
    """Positions and orientations of the head.

    Attributes:
        positions ((P, 3), m): World frame.
        rotations (P, 3, 3): Head to world.

    Raises:
        InputError: If shapes do not fit, a number is not finite, or a matrix is no rotation.
    """

    positions: Floats
    rotations: Floats

    def __post_init__(self) -> None:
        positions = np.asarray(self.positions, dtype=np.float64)
        rotations = np.asarray(self.rotations, dtype=np.float64)
        if positions.ndim != 2 or positions.shape[1] != 3:
            raise InputError(f"positions have shape {positions.shape}, expected (P, 3)")
        if rotations.shape != (len(positions), 3, 3):
            raise InputError(
                f"rotations have shape {rotations.shape}, expected ({len(positions)}, 3, 3)"
            )
        finite = np.isfinite(positions).all(axis=1) & np.isfinite(rotations).all(axis=(1, 2))
        _refuse(np.logical_not(finite), "hold NaN or infinite numbers; correct them")
        product = rotations @ rotations.swapaxes(1, 2)
        far = np.abs(product - np.eye(3)).max(axis=(1, 2)) > ORTHOGONAL
        _refuse(
            far | (np.linalg.det(rotations) < 0), "are no rotations; expected R @ R.T = 1, det 1"
        )
        object.__setattr__(self, "positions", positions)
        object.__setattr__(self, "rotations", rotations)

    def __len__(self) -> int:
        return len(self.positions)

    def __getitem__(self, index: int | slice | ArrayLike) -> Poses:
        """Return the chosen poses; one index gives poses of length one."""
        if isinstance(index, (int, np.integer)):
            index = [int(index)]
        elif not isinstance(index, slice):
            index = np.asarray(index)
        return Poses(self.positions[index], self.rotations[index])

    @classmethod
    def sphere(
        cls,
        count: int,
        *,
        radius: float,
        aim_jitter: float = 0.0,
        generator: np.random.Generator | None = None,
    ) -> Poses:
        """Return level poses on a spiral around the origin that look at it, each a little off.

        Args:
            count: Number of poses.
            radius (m): Distance from the origin.
            aim_jitter (rad): Standard deviation of the two turns about the head's own y and z axes.
            generator: Draws the turns; one of seed 0 by default.

        Raises:
            InputError: If there is no pose, or the radius is not above zero.
        """
        if count < 1 or not (math.isfinite(radius) and radius > 0.0):
            raise InputError(
                f"count is {count} and radius {radius} m, expected 1 or more and above 0 m"
            )
        generator = generator or np.random.default_rng(0)
        return _aimed(radius * fibonacci_sphere(count), aim_jitter, generator)

    @classmethod
    def looking_at(cls, positions: ArrayLike, target: ArrayLike = (0.0, 0.0, 0.0)) -> Poses:
        """Return level poses at places that look at a target.

        Args:
            positions ((P, 3), m): World frame.
            target ((3,), m): Point that poses look at.

        Raises:
            InputError: If shapes do not fit, or a position is the target.
        """
        places, aim = np.asarray(positions, np.float64), np.asarray(target, np.float64)
        if places.ndim != 2 or places.shape[1] != 3 or aim.shape != (3,):
            raise InputError(
                f"positions {places.shape} and target {aim.shape}, expected (P, 3) and (3,)"
            )
        _refuse(np.asarray((places == aim).all(axis=1)), "are the target itself")
        return cls(places, look_at(places, aim))

    @classmethod
    def read(cls, path: Path | str) -> Poses:
        """Read poses from a table with the header ``x,y,z,yaw,pitch,roll`` (m, degrees).

        Args:
            path: The columns may stand in any order; others are not allowed.

        Raises:
            InputError: If the file cannot be read, or anything in it is no finite number, naming
                file, line and column.
        """
        path = Path(path)
        header, rows = read_rows(path)
        if sorted(header) != sorted(CSV_COLUMNS):
            raise InputError(
                f"{path}:1: the header is {','.join(header)!r}, expected {','.join(CSV_COLUMNS)}"
            )
        values = np.array(
            [
                [number_in(path, line, name, cell) for name, cell in zip(header, row, strict=True)]
                for line, row in rows
            ]
        )
        columns = dict(zip(header, values.T, strict=True))
        angles = (np.radians(columns[name]) for name in ("yaw", "pitch", "roll"))
        positions = np.stack([columns[name] for name in ("x", "y", "z")], axis=1)
        return cls(positions, rotation_from_euler(*angles))

    def table(self) -> str:
        """Return the text of a table that :meth:`read` reads back (m, degrees)."""
        yaw, pitch, roll = (np.degrees(angle) for angle in euler_from_rotation(self.rotations))
        table = np.column_stack([self.positions, yaw, pitch, roll])
        lines = [",".join(CSV_COLUMNS), *(",".join(repr(float(v)) for v in row) for row in table)]
        return "\n".join(lines) + "\n"


def _refuse(bad: NDArray[np.bool_], what: str) -> None:
    if bad.any():
        first = ", ".join(str(index) for index in np.flatnonzero(bad)[:10])
        raise InputError(f"{bad.sum()} of {len(bad)} poses ({first}) {what}")


def rotation_from_euler(yaw: ArrayLike, pitch: ArrayLike, roll: ArrayLike) -> Floats:
    """Rotation matrices from yaw, pitch and roll.

    In: yaw, pitch, roll ((...,), rad). Out: rotations (..., 3, 3).

    Examples:
        >>> down = rotation_from_euler(0.0, math.pi / 6, 0.0)
        >>> [round(float(part), 3) for part in down @ [1.0, 0.0, 0.0]]
        [0.866, 0.0, -0.5]
    """
    yaw, pitch, roll = np.broadcast_arrays(*(np.asarray(a, np.float64) for a in (yaw, pitch, roll)))
    sy, cy = np.sin(yaw), np.cos(yaw)
    sp, cp = np.sin(pitch), np.cos(pitch)
    sr, cr = np.sin(roll), np.cos(roll)
    rows = [
        [cy * cp, cy * sp * sr - sy * cr, cy * sp * cr + sy * sr],
        [sy * cp, sy * sp * sr + cy * cr, sy * sp * cr - cy * sr],
        [-sp, cp * sr, cp * cr],
    ]
    return np.stack([np.stack(row, axis=-1) for row in rows], axis=-2)


def euler_from_rotation(rotations: ArrayLike) -> tuple[Floats, Floats, Floats]:
    """Yaw, pitch and roll of rotation matrices; looking straight up or down, yaw is 0.

    In: rotations (..., 3, 3). Out: yaw, pitch, roll ((...,), rad).
    """
    r = np.asarray(rotations, dtype=np.float64)
    level = np.hypot(r[..., 0, 0], r[..., 1, 0])
    pitch = np.arctan2(-r[..., 2, 0], level)
    # There, only yaw minus or plus roll is known; all of it is given to roll.
    upright = level < 1e-9
    yaw = np.where(upright, 0.0, np.arctan2(r[..., 1, 0], r[..., 0, 0]))
    roll = np.where(
        upright, np.arctan2(-r[..., 1, 2], r[..., 1, 1]), np.arctan2(r[..., 2, 1], r[..., 2, 2])
    )
    return yaw, pitch, roll


def look_at(positions: ArrayLike, target: ArrayLike) -> Floats:
    """Level rotations that look from positions at a target.

    In: positions ((..., 3), m), target ((3,) or (..., 3), m). Out: rotations (..., 3, 3).
    """
    forward = np.asarray(target, np.float64) - np.asarray(positions, np.float64)
    length = np.linalg.norm(forward, axis=-1)
    if not (length > 0.0).all():
        raise ValueError("a position is the target itself; there is no direction to look in")
    level = np.hypot(forward[..., 0], forward[..., 1])
    yaw = np.where(level > 1e-9 * length, np.arctan2(forward[..., 1], forward[..., 0]), 0.0)
    return rotation_from_euler(yaw, -np.arctan2(forward[..., 2], level), 0.0)


def cylinder_poses(
    count: int,
    *,
    radius: float,
    heights: tuple[float, float],
    aim_jitter: float,
    generator: np.random.Generator,
) -> Poses:
    """Poses on a spiral around the z axis that look level at it, each a little off.

    As of a turntable before a column of sensors. ``heights`` holds the lowest and the highest z, m;
    the others, and the result, as :meth:`Poses.sphere`.
    """
    share = (np.arange(count) + 0.5) / count
    turn = np.arange(count, dtype=np.float64) * math.pi * (3.0 - math.sqrt(5.0))  # golden angle
    return _around(radius, heights, share, turn, aim_jitter, generator)


def random_cylinder_poses(
    count: int,
    *,
    radius: float,
    heights: tuple[float, float],
    aim_jitter: float,
    generator: np.random.Generator,
) -> Poses:
    """Poses at random places of a cylinder; parameters and result as :func:`cylinder_poses`."""
    share, turn = generator.random((2, count))
    return _around(radius, heights, share, 2.0 * math.pi * turn, aim_jitter, generator)


def _around(
    radius: float,
    heights: tuple[float, float],
    share: Floats,
    turn: Floats,
    aim_jitter: float,
    generator: np.random.Generator,
) -> Poses:
    low, high = heights
    height = low + share * (high - low)
    axis = np.stack((np.zeros_like(height), np.zeros_like(height), height), axis=1)
    around = np.stack((np.cos(turn), np.sin(turn), np.zeros_like(turn)), axis=1)
    return _aimed(axis + radius * around, aim_jitter, generator, axis)


def _aimed(
    positions: Floats,
    aim_jitter: float,
    generator: np.random.Generator,
    targets: ArrayLike = (0.0, 0.0, 0.0),
) -> Poses:
    """Look at targets, then off them by two random turns about the head's own y and z."""
    about_y, about_z = aim_jitter * generator.standard_normal((2, len(positions)))
    jittered = look_at(positions, targets) @ rotation_from_euler(about_z, about_y, 0.0)
    return Poses(positions, look_at(np.zeros_like(positions), jittered[:, :, 0]))


def random_sphere_poses(
    count: int, *, radius: float, aim_jitter: float, generator: np.random.Generator
) -> Poses:
    """Poses at random places of a sphere; parameters and result as :meth:`Poses.sphere`."""
    places = generator.standard_normal((count, 3))
    places /= np.linalg.norm(places, axis=1, keepdims=True)
    return _aimed(radius * places, aim_jitter, generator)


def cap_poses(
    count: int,
    *,
    radius: float,
    axis: ArrayLike,
    half_angle: float,
    aim_jitter: float,
    generator: np.random.Generator,
) -> Poses:
    """Poses on a spiral over a cap of a sphere that look at the origin, each a little off.

    ``axis`` (3,), of any length but zero, points from the origin to the middle of the cap, and
    ``half_angle`` (rad, 0 to pi) is that from the axis to the rim; the others, and the result, as
    :meth:`Poses.sphere`.
    """
    spiral = fibonacci_cap(count, axis=axis, half_angle=half_angle, offset=(0.5, 0.0))
    return _aimed(radius * spiral, aim_jitter, generator)


def random_poses(
    count: int,
    *,
    radius: tuple[float, float],
    axis: ArrayLike,
    half_angle: float,
    aim_jitter: float,
    generator: np.random.Generator,
) -> Poses:
    """Poses at random places between two spheres and within a cone, uniform in volume.

    ``radius`` holds the least and the greatest distance from the origin, m; if they are the same,
    the places are uniform over a cap of that sphere. The others, and the result, as
    :func:`cap_poses`.
    """
    height, turn, depth = generator.random((3, count))
    # Equal steps along the axis cut a sphere into equal areas; equal steps of r^3, equal volumes.
    along = 1.0 - height * 2.0 * math.sin(half_angle / 2.0) ** 2
    across = np.sqrt(1.0 - along**2)
    turn = 2.0 * math.pi * turn
    places = np.stack([along, across * np.cos(turn), across * np.sin(turn)], axis=1)
    near, far = radius
    distance = near if near == far else np.cbrt(near**3 + depth * (far**3 - near**3))[:, None]
    places = distance * (places @ look_at(np.zeros(3), axis).T)
    return _aimed(places, aim_jitter, generator)


MAX_AIM_ERROR = np.radians(45.0)
"""Median angle between the heads' aim and the body above which a mistake is suspected, rad. Bats
aim within some degrees; a call is half as loud 30 to 40 degrees off its axis."""
MAX_EXPLAINED_AIM_ERROR = np.radians(20.0)
"""Median angle between the heads' corrected aim and the body below which a suspected mistake counts
as the explanation, rad."""


def off_axis(poses: Poses, centre: Floats) -> Floats:
    """Return the angles (P,) between where heads look and where a body is, rad.

    In: centre ((3,), m).
    """
    to_body = centre - poses.positions
    distance = np.linalg.norm(to_body, axis=1)
    ahead = (to_body * poses.rotations[:, :, 0]).sum(axis=1)
    return np.arccos((ahead / np.maximum(distance, 1e-12)).clip(-1.0, 1.0))


def aim_fault(poses: Poses, centre: Floats) -> str:
    """Return a line if poses look away from a body, and its likely cause; empty otherwise.

    In: centre ((3,), m).
    """
    if not len(poses):
        return ""
    stated = float(np.median(off_axis(poses, centre)))
    if stated < MAX_AIM_ERROR:
        return ""
    yaw, pitch, roll = (np.asarray(a) for a in euler_from_rotation(poses.rotations))
    others: dict[str, list[Floats]] = {
        "yaw and pitch are swapped": [pitch, yaw, roll],
        "the sign of pitch is the opposite one (positive pitch looks down)": [yaw, -pitch, roll],
        "the sign of yaw is the opposite one": [-yaw, pitch, roll],
        "the poses look the other way": [yaw + np.pi, -pitch, -roll],
    }
    degrees = [np.degrees(angle) for angle in (yaw, pitch, roll)]
    if max(np.abs(angle).max() for angle in degrees) <= 2.0 * np.pi:
        others["angles are in radians, and are read as degrees"] = degrees
    angles = {}
    for name, turns in others.items():
        corrected = Poses(poses.positions, rotation_from_euler(*turns))
        angles[name] = float(np.median(off_axis(corrected, centre)))
    best = min(angles, key=angles.__getitem__)
    cause = f"; perhaps {best}" if angles[best] < min(MAX_EXPLAINED_AIM_ERROR, stated / 2.0) else ""
    where = "look away from" if stated > np.pi / 2.0 else "look past"
    return f"poses {where} the body, by {np.degrees(stated):.0f} degrees in the median{cause}"


FrameName = Literal["auto", "world", "original"]
KEYS = ("to_original", "head_to_original")
"""Attributes of a store that state its original frame."""
UNITS = {1.0: "m", 0.01: "cm", 0.001: "mm"}


@dataclass(frozen=True, eq=False)
class Frame:
    """A frame beside the world's (m, right-handed, z up; the head's x forward, y left, z up)."""

    # (4, 4): From the world's frame and metres to this frame and its unit
    matrix: Floats = field(default_factory=lambda: np.eye(4))
    # (3, 3): From our axes of the head to this frame's
    head: Floats = field(default_factory=lambda: np.eye(3))

    @classmethod
    def of(cls, attributes: Mapping[str, Any], name: FrameName = "auto") -> Frame:
        """Return a frame that the attributes of a store, or a run's provenance, state."""
        recorded = attributes.get("origin") == "recorded"
        if name == "world" or (name == "auto" and not recorded):
            return cls()
        matrix, head = (attributes.get(key) for key in KEYS)
        frame = cls(
            np.eye(4) if matrix is None else np.asarray(matrix, dtype=np.float64),
            np.eye(3) if head is None else np.asarray(head, dtype=np.float64),
        )
        if frame.matrix.shape != (4, 4) or frame.head.shape != (3, 3):
            raise InputError("to_original is no 4 by 4 matrix; import or simulate again")
        turn = frame.matrix[:3, :3] * (frame.unit if np.isfinite(frame.unit) else 0.0)
        if not all(np.allclose(each @ each.T, np.eye(3), atol=1e-3) for each in (turn, frame.head)):
            raise InputError("to_original is no similarity; import or simulate again")
        return frame

    @property
    def unit(self) -> float:
        """Length of the unit, m."""
        size = abs(float(np.linalg.det(self.matrix[:3, :3])))
        return size ** (-1.0 / 3.0) if size > 0.0 else np.inf

    @property
    def unit_name(self) -> str:
        """Name of the unit."""
        near = [name for unit, name in UNITS.items() if abs(self.unit / unit - 1.0) < 1e-3]
        return near[0] if near else f"{self.unit:.6g} m"

    @property
    def is_world(self) -> bool:
        """Whether it is the world's frame, in metres."""
        return np.allclose(self.matrix, np.eye(4)) and np.allclose(self.head, np.eye(3))

    @property
    def name(self) -> str:
        """Text for files."""
        if self.is_world:
            return "world frame, right-handed, z up, m"
        return f"frame of the recordings or of the scene's file, {self.unit_name}"

    def places(self, places: ArrayLike) -> Floats:
        """Return places (..., 3) of the world (m) in this frame and unit."""
        return np.asarray(places, np.float64) @ self.matrix[:3, :3].T + self.matrix[:3, 3]

    def directions(self, directions: ArrayLike) -> Floats:
        """Return directions (..., 3) of the world in this frame."""
        return np.asarray(directions, np.float64) @ (self.matrix[:3, :3] * self.unit).T

    def rotations(self, rotations: ArrayLike) -> Floats:
        """Return rotations (..., 3, 3), head to world, from this frame's head to its world."""
        turn = self.matrix[:3, :3] * self.unit
        return np.asarray(turn @ np.asarray(rotations, np.float64) @ self.head.T)

    def mesh(self, mesh: trimesh.Trimesh) -> trimesh.Trimesh:
        """Return a mesh of the world in this frame and unit."""
        return _moved(mesh, self.matrix)

    def to_world(self, mesh: trimesh.Trimesh) -> trimesh.Trimesh:
        """Return a mesh whose axes are this frame's, but whose unit is the metre, in the world."""
        metres = np.diag([1.0 / self.unit] * 3 + [1.0])
        return _moved(mesh, np.asarray(np.linalg.inv(self.matrix) @ metres, np.float64))


def _moved(mesh: trimesh.Trimesh, matrix: Floats) -> trimesh.Trimesh:
    """Return a moved copy whose triangles still wind around their outward normals."""
    places = mesh.vertices @ matrix[:3, :3].T + matrix[:3, 3]
    faces = mesh.faces if np.linalg.det(matrix[:3, :3]) > 0.0 else mesh.faces[:, ::-1]
    return trimesh.Trimesh(places, faces, process=False)
