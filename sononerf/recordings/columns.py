# SPDX-License-Identifier: MIT
"""Tables of poses: named columns whose units stand in their names or in the settings.

=======================  ===========================================================================
columns                  what they are
=======================  ===========================================================================
x, y, z                  the head's place: a length
yaw, pitch, roll         its orientation: angles
qw, qx, qy, qz           or a unit quaternion
angle, height            or a turntable's: an angle and a length
file, time               which recording holds the ping, and when its call left, s
split                    train, val or test
=======================  ===========================================================================

A unit is appended to a name with an underscore: ``x_mm``, ``yaw_deg``, ``time_ms``.
"""

from __future__ import annotations

import difflib
import math
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import ArrayLike, NDArray

from sononerf.array_types import Floats
from sononerf.echoes.layout import SPLITS
from sononerf.errors import InputError
from sononerf.settings.import_schema import LENGTHS, ImportSettings
from sononerf.tables import number_in, read_rows

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
    """One table, in SI units and radians, in its own frame.

    Attributes:
        where: The table, for messages.
        values: Numbers by name, each (P,).
        texts: Text by name, each of P.
        rotation ((P, 3, 3) or None): Head to world as matrices, where the source has them.
        units: The unit that each length and angle was given in.
    """

    where: str
    values: dict[str, Floats]
    texts: dict[str, list[str]]
    rotation: Floats | None
    units: dict[str, str]

    def __len__(self) -> int:
        for column in self.values.values():
            return len(column)
        for words in self.texts.values():
            return len(words)
        return 0 if self.rotation is None else len(self.rotation)

    def has(self, *names: str) -> bool:
        """Return whether there are all of these columns."""
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
    """Bring named columns into SI units.

    In: given (dict of (P,) float), rotation (P, 3, 3).
    """
    values: dict[str, Floats] = {}
    units: dict[str, str] = {}
    for full, column in given.items():
        name, unit = _parted(where, full)
        if name in values:
            raise InputError(f"{where}: column {name} stands twice; leave one of them out")
        kind = KINDS[name]
        if kind in ("length", "angle"):
            stated = getattr(settings, kind)
            if unit is None and stated is None:
                known = UNITS[kind]
                example = f"{name}_{next(iter(known))}"
                raise InputError(
                    f"{where}: column {full} has no unit; name it {example} or set import.{kind} "
                    f"to one of {', '.join(known)}"
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
        known = UNITS.get(kind, {})
        if unit in known:
            return name, unit
        raise InputError(
            f"{where}: column {full}: unknown unit {unit!r}; known: {', '.join(known) or 'none'}"
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
