# SPDX-License-Identifier: MIT
"""Tables of poses: columns, units and conventions of rotations, and the poses they mean."""

from __future__ import annotations

import difflib
import math
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from sononerf.display import number_in, read_rows
from sononerf.echoes.memory_ensemble import SPLITS
from sononerf.errors import InputError, SettingsError
from sononerf.geometry.poses import Poses, look_at, rotation_from_euler
from sononerf.numerics import Floats
from sononerf.settings.sections import LENGTHS, ImportSettings, TurntableSettings

ANGLES = {"deg": math.pi / 180.0, "rad": 1.0}
TIMES = {"s": 1.0, "ms": 1e-3, "us": 1e-6}
PLACE, EULER, QUATERNION = ("x", "y", "z"), ("yaw", "pitch", "roll"), ("qw", "qx", "qy", "qz")
KINDS = {
    **dict.fromkeys((*PLACE, "height"), "length"),
    **dict.fromkeys((*EULER, "angle"), "angle"),
    **dict.fromkeys(QUATERNION, "number"),
    "time": "time",
}
TEXTS = ("file", "split")
UNITS = {"length": LENGTHS, "angle": ANGLES, "time": TIMES}


@dataclass(frozen=True, eq=False)
class Columns:
    """One table, in SI units and radians, in its own frame."""

    where: str  # The table, for messages
    values: dict[str, Floats]  # Numbers by name, each (P,)
    texts: dict[str, list[str]]  # Text by name, each of P
    # (P, 3, 3) or None: Head to world as matrices, where the source has them
    rotation: Floats | None
    units: dict[str, str]  # The unit that each length and angle was given in

    def __len__(self) -> int:
        for column in self.values.values():
            return len(column)
        for words in self.texts.values():
            return len(words)
        return 0 if self.rotation is None else len(self.rotation)

    def has(self, *names: str) -> bool:
        """Return True if all of these columns are there."""
        return all(name in self.values for name in names)

    def take(self, rows: ArrayLike) -> Columns:
        """Return the table of the chosen rows."""
        chosen = np.asarray(rows)
        return Columns(
            self.where,
            {name: column[chosen] for name, column in self.values.items()},
            {name: [column[int(row)] for row in chosen] for name, column in self.texts.items()},
            None if self.rotation is None else self.rotation[chosen],
            self.units,
        )

    def split(self) -> NDArray[np.int8] | None:
        """Return the use of each pose, (P,): 0 training, 1 validation, 2 test; None if unknown."""
        words = self.texts.get("split")
        if words is None:
            return None
        bad = [row for row, word in enumerate(words) if word not in SPLITS]
        if bad:
            raise InputError(
                f"{self.where}: column split of row {bad[0] + 1} is {words[bad[0]]!r}, expected "
                f"{', '.join(SPLITS)}"
            )
        return np.array([SPLITS[word] for word in words], dtype=np.int8)


def columns_of(
    where: str,
    given: dict[str, ArrayLike],
    settings: ImportSettings,
    *,
    texts: dict[str, list[str]] | None = None,
    rotation: ArrayLike | None = None,
) -> Columns:
    """Bring named columns into SI units. In: given (dict of (P,) float), rotation (P, 3, 3)."""
    values: dict[str, Floats] = {}
    units: dict[str, str] = {}
    for full, column in given.items():
        name, unit = _parted(where, full)
        if name in values:
            raise InputError(f"{where}: duplicate column {name}; leave one of them out")
        kind = KINDS[name]
        if kind in ("length", "angle"):
            stated = getattr(settings, kind)
            if unit is None and stated is None:
                factors = UNITS[kind]
                example = f"{name}_{next(iter(factors))}"
                raise InputError(
                    f"{where}: column {full} has no unit; name it {example} or set import.{kind} "
                    f"to one of {', '.join(factors)}"
                )
            unit = unit or stated
            units[name] = unit
        factor = UNITS[kind][unit or "s"] if kind in UNITS else 1.0
        values[name] = factor * np.asarray(column, dtype=np.float64)
        bad = ~np.isfinite(values[name])
        if bad.any():
            row = int(bad.argmax()) + 1
            raise InputError(f"{where}: column {full} of row {row} is no finite number")
    matrices = None if rotation is None else np.asarray(rotation, dtype=np.float64)
    return Columns(where, values, texts or {}, matrices, units)


def _parted(where: str, full: str) -> tuple[str, str | None]:
    """Return a column's name and the unit in it, if any."""
    name, _, unit = full.rpartition("_")
    if full in KINDS:
        return full, None
    if name in KINDS:
        kind = KINDS[name]
        units = UNITS.get(kind, {})
        if unit in units:
            return name, unit
        raise InputError(
            f"{where}: column {full}: unknown unit {unit!r}; known: {', '.join(units) or 'none'}"
        )
    if not full or full.startswith("Unnamed"):
        raise InputError(
            f"{where}: a column has no name; if it is an index, as pandas writes it, leave it out "
            "(index=False)"
        )
    allowed = [*KINDS, *TEXTS]
    near = difflib.get_close_matches(full.lower(), allowed, n=1)
    hint = f"did you mean {near[0]}?" if near else f"known: {', '.join(allowed)}"
    raise InputError(f"{where}: unknown column {full!r}; {hint}")


def read_table(path: Path, settings: ImportSettings) -> Columns:
    """Read a CSV table of poses with one header line."""
    header, rows = read_rows(path)
    numbers: dict[str, list[float]] = {name: [] for name in header if name not in TEXTS}
    texts: dict[str, list[str]] = {name: [] for name in header if name in TEXTS}
    for name in numbers:
        _parted(f"{path}:1", name)
    for line, row in rows:
        for name, cell in zip(header, row, strict=True):
            if name in texts:
                texts[name].append(cell.strip())
            else:
                numbers[name].append(number_in(path, line, name, cell))
    return columns_of(str(path), {**numbers}, settings, texts=texts)


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
    positions = np.stack([columns.values[name] for name in PLACE], axis=1)
    own = _rotations(columns, settings, world, head)
    if settings.inverse is not None:
        if own is None:
            raise SettingsError("import.inverse: the table has no rotations; leave it out")
        own = own.transpose(0, 2, 1)
        if settings.inverse == "poses":
            positions = -np.einsum("pij,pj->pi", own, positions)
    positions = positions @ world.T
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


def has_rotations(columns: Columns) -> bool:
    """Return True if the table itself states where each head looks."""
    return columns.rotation is not None or any(
        name in columns.values for name in (*EULER, *QUATERNION)
    )


def _rotations(
    columns: Columns, settings: ImportSettings, world: Floats, head: Floats
) -> Floats | None:
    """Return rotations in the table's own frames, (P, 3, 3); None where it has none."""
    forms = [
        name
        for name, there in (
            ("rotation", columns.rotation is not None),
            ("yaw, pitch, roll", any(name in columns.values for name in EULER)),
            ("qw, qx, qy, qz", any(name in columns.values for name in QUATERNION)),
        )
        if there
    ]
    if len(forms) > 1:
        raise InputError(f"{columns.where}: holds both {' and '.join(forms)}; leave one out")
    if columns.rotation is not None:
        return _checked_rotation(columns, columns.rotation)
    names = EULER if "yaw, pitch, roll" in forms else QUATERNION
    missing = [name for name in names if name not in columns.values] if forms else []
    if missing:
        raise InputError(f"{columns.where}: column {missing[0]} is missing beside {forms[0]}")
    if not forms:
        return None
    parts = [columns.values[name] for name in names]
    if names == QUATERNION:
        return _from_quaternion(columns, np.stack(parts, axis=1))
    yaw, pitch, roll = parts
    if settings.positive_pitch is not None and settings.positive_pitch != _pitch(world, head):
        pitch = -pitch
    if settings.euler == "xyz":
        return rotation_from_euler(-yaw, -pitch, -roll).transpose(0, 2, 1)
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
