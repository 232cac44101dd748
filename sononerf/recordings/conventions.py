# SPDX-License-Identifier: MIT
"""Conversion of poses from other conventions to ours: metres, z up, head x forward, y left, z up.

======  ===================================  =====================================
frame   world axes                           head axes
======  ===================================  =====================================
enu     x east, y north, z up                x forward, y left, z up (ours)
ned     x north, y east, z down              x forward, y right, z down
camera  any right-handed ones                x right, y down, z forward
own     ``axes`` takes its vectors to ours   ``head_axes`` does; ``axes`` if unset
======  ===================================  =====================================

With W the matrix of the world's axes and B that of the head's, a place is :math:`W p` and a
rotation :math:`W R B^T`. A left-handed frame has matrices of determinant -1. Angles follow
:math:`R = R_z(yaw) R_y(pitch) R_x(roll)` in the table's own axes: positive pitch looks down in
enu and up in ned.
"""

from __future__ import annotations

from typing import Any

import numpy as np

from sononerf.array_types import Floats
from sononerf.errors import InputError, SettingsError
from sononerf.geometry.poses import Poses, look_at, rotation_from_euler
from sononerf.recordings.columns import EULER, PLACE, QUATERNION, Columns
from sononerf.settings.import_schema import LENGTHS, ImportSettings, TurntableSettings

NED_TO_ENU = ((0.0, 1.0, 0.0), (1.0, 0.0, 0.0), (0.0, 0.0, -1.0))
DOWN_TO_UP = ((1.0, 0.0, 0.0), (0.0, -1.0, 0.0), (0.0, 0.0, -1.0))
CAMERA_TO_HEAD = ((0.0, 0.0, 1.0), (-1.0, 0.0, 0.0), (0.0, -1.0, 0.0))
SLACK = 1e-3
"""Largest deviation of rotations and unit quaternions from exact ones, no unit: four printed
digits."""


def frame_matrices(settings: ImportSettings) -> tuple[Floats, Floats]:
    """Return the matrices (3, 3) that take the world's and the head's axes to ours."""
    if settings.frame == "own":
        world = np.asarray(settings.axes, dtype=np.float64)
        head = world if settings.head_axes is None else np.asarray(settings.head_axes, np.float64)
        for name, matrix in (("axes", world), ("head_axes", head)):
            if not np.allclose(matrix @ matrix.T, np.eye(3), atol=SLACK):
                raise SettingsError(
                    f"import.{name}: its rows are no unit vectors at right angles; expected one "
                    "such as [[1,0,0],[0,-1,0],[0,0,1]]"
                )
        if np.linalg.det(world) * np.linalg.det(head) < 0.0:
            raise SettingsError(
                "import.head_axes: one of world and head is left-handed and the other is not"
            )
        return world, head
    world, head = {
        "enu": (np.eye(3), np.eye(3)),
        "ned": (np.array(NED_TO_ENU), np.array(DOWN_TO_UP)),
        "camera": (np.eye(3), np.array(CAMERA_TO_HEAD)),
    }[settings.frame]
    return world, head


def original_frame(columns: Columns, settings: ImportSettings) -> dict[str, Any]:
    """Return the matrices that lead back from our frame and metres; none for a turntable."""
    if settings.turntable is not None:
        return {}
    world, head = frame_matrices(settings)
    matrix = np.eye(4)
    matrix[:3, :3] = world.T / LENGTHS[columns.units.get(PLACE[0], "m")]
    return {"to_original": matrix.tolist(), "head_to_original": head.T.tolist()}


def to_poses(columns: Columns, settings: ImportSettings) -> Poses:
    """Return the poses of a table in our frame."""
    if settings.turntable is not None:
        return _turntable_of(columns, settings.turntable)
    if not columns.has(*PLACE):
        missing = [name for name in PLACE if name not in columns.values]
        hint = "; set import.turntable.radius" if columns.has("angle") else ""
        raise InputError(f"{columns.where}: column {missing[0]} is missing{hint}")
    world, head = frame_matrices(settings)
    positions = np.stack([columns.values[name] for name in PLACE], axis=1) @ world.T
    own = _rotations(columns, settings, world, head)
    if own is not None:
        return Poses(positions, world @ own @ head.T)
    if settings.look_at is None:
        raise InputError(
            f"{columns.where}: no orientation; add columns yaw, pitch, roll or qw, qx, qy, qz, or "
            "set import.look_at to the place that all poses look at"
        )
    try:
        return Poses(positions, look_at(positions, settings.look_at))
    except ValueError as error:
        raise InputError(f"{columns.where}: import.look_at: {error}") from None


def _rotations(
    columns: Columns, settings: ImportSettings, world: Floats, head: Floats
) -> Floats | None:
    """Return rotations in the table's own frames, (P, 3, 3); None where it has none."""
    found = [
        name
        for name, there in (
            ("rotation", columns.rotation is not None),
            ("yaw, pitch, roll", any(name in columns.values for name in EULER)),
            ("qw, qx, qy, qz", any(name in columns.values for name in QUATERNION)),
        )
        if there
    ]
    if len(found) > 1:
        raise InputError(f"{columns.where}: holds both {' and '.join(found)}; leave one out")
    if columns.rotation is not None:
        return _checked_rotation(columns, columns.rotation)
    names = EULER if "yaw, pitch, roll" in found else QUATERNION
    missing = [name for name in names if name not in columns.values] if found else []
    if missing:
        raise InputError(f"{columns.where}: column {missing[0]} is missing beside {found[0]}")
    if not found:
        return None
    parts = [columns.values[name] for name in names]
    if names == QUATERNION:
        return _from_quaternion(columns, np.stack(parts, axis=1))
    yaw, pitch, roll = parts
    if settings.positive_pitch is not None and settings.positive_pitch != _pitch(world, head):
        pitch = -pitch
    return rotation_from_euler(yaw, pitch, roll)


def _pitch(world: Floats, head: Floats) -> str:
    """Return where positive pitch looks by the formula."""
    own = rotation_from_euler(0.0, 0.1, 0.0)
    return "up" if (world @ own @ head.T)[2, 0] > 0.0 else "down"


def _checked_rotation(columns: Columns, rotation: Floats) -> Floats:
    product = rotation @ rotation.transpose(0, 2, 1)
    wrong = ~np.isclose(product, np.eye(3), atol=SLACK).all(axis=(1, 2))
    if wrong.any():
        raise InputError(
            f"{columns.where}: the rotation of ping {int(wrong.argmax())} is no rotation matrix"
        )
    if (np.linalg.det(rotation) < 0.0).any():
        raise InputError(
            f"{columns.where}: the rotation of ping {int(np.linalg.det(rotation).argmin())} is a "
            "mirror image; give a left-handed frame as import.frame=own with import.axes"
        )
    return rotation


def _from_quaternion(columns: Columns, quaternion: Floats) -> Floats:
    length = np.linalg.norm(quaternion, axis=1)
    wrong = np.abs(length - 1.0) > 10.0 * SLACK
    if wrong.any():
        row = int(wrong.argmax())
        raise InputError(
            f"{columns.where}: the quaternion of row {row + 1} has length {length[row]:.3g}, "
            "expected 1"
        )
    w, x, y, z = (quaternion / length[:, None]).T
    rows = [
        [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
        [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
        [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
    ]
    return np.stack([np.stack(row, axis=-1) for row in rows], axis=-2)


def _turntable_of(columns: Columns, settings: TurntableSettings) -> Poses:
    if not columns.has("angle"):
        raise InputError(f"{columns.where}: column angle is missing; import.turntable needs it")
    angle = columns.values["angle"]
    height = columns.values.get("height", np.zeros(len(angle))) + settings.height
    return turntable_poses(
        angle, height, radius=settings.radius, clockwise=settings.turns == "clockwise"
    )


def turntable_poses(angle: Floats, height: Floats, *, radius: float, clockwise: bool) -> Poses:
    """Poses of a fixed sensor beside a turning object, seen from the object.

    In: angle ((P,), rad), height ((P,), m), radius (m).
    """
    turn = np.asarray(angle) * (1.0 if clockwise else -1.0)
    level = np.asarray(height, dtype=np.float64)
    positions = np.stack([radius * np.cos(turn), radius * np.sin(turn), level], axis=1)
    return Poses(positions, look_at(positions, np.stack([0 * level, 0 * level, level], axis=1)))
