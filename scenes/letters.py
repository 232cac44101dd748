# SPDX-License-Identifier: MIT
"""Text in a stroke font, A to Z and 0 to 9, out of round tubes; read from +x."""

from __future__ import annotations

import itertools
from typing import Annotated

import numpy as np
import trimesh
from pydantic import Field

from sononerf.errors import SettingsError
from sononerf.scene import MATERIALS, MaterialName, Scene

from .bodies import Degrees, placed, tube

Point = tuple[float, float]
Stroke = tuple[Point, ...]

THINNER = 0.02
"""Fraction by which each stroke of a letter is thinner than the one before. If two strokes share an
end, one then lies inside the other, and no surfaces coincide."""
SPACING = 0.15
"""Gap between letters, and a third of the width of a space, letter heights."""


def _line(*points: Point) -> tuple[Stroke, ...]:
    """Return a line with corners, as one stroke from each to the next."""
    return tuple(itertools.pairwise(points))


def _arc(y: float, z: float, wide: float, high: float, start: float, end: float) -> Stroke:
    """Return part of an ellipse about (y, z), half axes wide and high, between degrees."""
    angle = np.radians(np.linspace(start, end, 200))
    points = zip(y + wide * np.cos(angle), z + high * np.sin(angle), strict=True)
    return tuple((float(a), float(b)) for a, b in points)


def _turned(strokes: tuple[Stroke, ...], width: float) -> tuple[Stroke, ...]:
    """Return a letter upside down."""
    return tuple(tuple((width - y, 1.0 - z) for y, z in stroke) for stroke in strokes)


_STEM = _line((0.0, 0.0), (0.0, 1.0))
_UPPER_BOWL: Stroke = ((0.0, 1.0), *_arc(0.3, 0.75, 0.25, 0.25, 90, -90), (0.0, 0.5))
_SIX = (_arc(0.3, 0.3, 0.3, 0.3, 0, 360), _arc(0.55, 0.3, 0.55, 0.7, 100, 180))

# Strokes (y, z) in units of the letter's height, without corners; thickness is added all round.
FONT: dict[str, tuple[Stroke, ...]] = {
    "A": (*_line((0.0, 0.0), (0.33, 1.0), (0.66, 0.0)), *_line((0.11, 0.33), (0.55, 0.33))),
    "B": (*_STEM, _UPPER_BOWL, (*_arc(0.3, 0.25, 0.3, 0.25, 90, -90), (0.0, 0.0))),
    "C": (_arc(0.38, 0.5, 0.38, 0.5, 50, 310),),
    "D": (*_STEM, ((0.0, 1.0), *_arc(0.2, 0.5, 0.42, 0.5, 90, -90), (0.0, 0.0))),
    "E": (*_line((0.55, 0.0), (0.0, 0.0), (0.0, 1.0), (0.55, 1.0)), ((0.0, 0.5), (0.45, 0.5))),
    "F": (*_line((0.0, 0.0), (0.0, 1.0), (0.55, 1.0)), ((0.0, 0.5), (0.45, 0.5))),
    "G": (_arc(0.38, 0.5, 0.38, 0.5, 50, 360), ((0.76, 0.5), (0.42, 0.5))),
    "H": (*_STEM, ((0.6, 0.0), (0.6, 1.0)), ((0.0, 0.5), (0.6, 0.5))),
    "I": _STEM,
    "J": (((0.5, 1.0), *_arc(0.25, 0.25, 0.25, 0.25, 0, -180)),),
    "K": (*_STEM, ((0.6, 1.0), (0.0, 0.4)), ((0.2, 0.6), (0.6, 0.0))),
    "L": _line((0.0, 1.0), (0.0, 0.0), (0.55, 0.0)),
    "M": _line((0.0, 0.0), (0.0, 1.0), (0.4, 0.3), (0.8, 1.0), (0.8, 0.0)),
    "N": _line((0.0, 0.0), (0.0, 1.0), (0.65, 0.0), (0.65, 1.0)),
    "O": (_arc(0.4, 0.5, 0.4, 0.5, 0, 360),),
    "P": (*_STEM, _UPPER_BOWL),
    "Q": (_arc(0.4, 0.5, 0.4, 0.5, 0, 360), ((0.5, 0.3), (0.8, 0.0))),
    "R": (*_STEM, _UPPER_BOWL, ((0.28, 0.5), (0.6, 0.0))),
    "S": ((*_arc(0.3, 0.75, 0.3, 0.25, 30, 270), *_arc(0.3, 0.25, 0.3, 0.25, 90, -150)[1:]),),
    "T": (*_line((0.0, 1.0), (0.7, 1.0)), *_line((0.35, 0.0), (0.35, 1.0))),
    "U": (((0.0, 1.0), *_arc(0.3, 0.3, 0.3, 0.3, 180, 360), (0.6, 1.0)),),
    "V": _line((0.0, 1.0), (0.33, 0.0), (0.66, 1.0)),
    "W": _line((0.0, 1.0), (0.22, 0.0), (0.45, 0.8), (0.68, 0.0), (0.9, 1.0)),
    "X": (*_line((0.0, 0.0), (0.62, 1.0)), *_line((0.0, 1.0), (0.62, 0.0))),
    "Y": (*_line((0.0, 1.0), (0.33, 0.5), (0.66, 1.0)), *_line((0.33, 0.5), (0.33, 0.0))),
    "Z": _line((0.0, 1.0), (0.6, 1.0), (0.0, 0.0), (0.6, 0.0)),
    "0": (_arc(0.3, 0.5, 0.3, 0.5, 0, 360),),
    "1": _line((0.0, 0.72), (0.22, 1.0), (0.22, 0.0)),
    "2": ((*_arc(0.3, 0.7, 0.3, 0.3, 160, -46.4), (0.0, 0.0)), ((0.0, 0.0), (0.6, 0.0))),
    "3": (_arc(0.3, 0.75, 0.25, 0.25, 150, -90), _arc(0.3, 0.25, 0.3, 0.25, 90, -150)),
    "4": _line((0.45, 0.0), (0.45, 1.0), (0.0, 0.3), (0.62, 0.3)),
    "5": (
        *_line((0.55, 1.0), (0.06, 1.0), (0.035, 0.526)),
        _arc(0.28, 0.32, 0.32, 0.32, 140, -140),
    ),
    "6": _SIX,
    "7": _line((0.0, 1.0), (0.6, 1.0), (0.2, 0.0)),
    "8": (_arc(0.3, 0.27, 0.3, 0.27, 0, 360), _arc(0.3, 0.77, 0.23, 0.23, 0, 360)),
    "9": _turned(_SIX, 0.6),
}


def letters(
    text: Annotated[str, Field(min_length=1, max_length=12)] = "BAT",
    height: Annotated[float, Field(ge=0.01, le=0.5)] = 0.1,
    stroke: Annotated[float, Field(ge=0.03, le=0.12)] = 0.08,
    yaw: Degrees = 0.0,
    pitch: Degrees = 0.0,
    roll: Degrees = 0.0,
    material: MaterialName = "rigid",
) -> Scene:
    """Build text of a height (m) in the y-z plane; the strokes' radius is a share of the height."""
    unknown = sorted({letter for letter in text.upper() if letter not in FONT and letter != " "})
    if unknown or not text.strip():
        found = f"no letter {unknown[0]!r}" if unknown else "nothing but spaces"
        raise SettingsError(f"scene.options.text: {found}; allowed are A to Z, 0 to 9 and spaces")
    radius = stroke * height
    scale = height - 2.0 * radius
    bodies, y = [], 0.0
    for letter in text.upper():
        if letter == " ":
            y += 3.0 * SPACING * height
            continue
        strokes = [scale * np.array(points) for points in FONT[letter]]
        for number, points in enumerate(strokes):
            bodies.append(tube(points + np.array((y, 0.0)), radius * (1.0 - THINNER * number)))
        y += max(points[:, 0].max() for points in strokes) + 2.0 * radius + SPACING * height
    mesh = trimesh.util.concatenate(bodies)
    return Scene(placed(mesh, yaw, pitch, roll), MATERIALS[material])
