# SPDX-License-Identifier: MIT
"""A leaf's blade: from places on it to points in space, and back.

Places are (along, across): lengths on the flat blade from its middle, along the midrib towards the
tip and square to it. Heights are lengths above it. Unbent, the three are z, y and x. Curl and bend
roll this space up one way and the other without folding it, so a sheet whose upper side is higher
than its lower side everywhere never meets itself.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from .sheet import Outline

Values = NDArray[np.float64]

PETIOLE_LENGTH, PETIOLE = 0.02, 1.2e-3
"""Length of the stalk beyond the blade, and half of its width, m."""
ROUND, POINTED = 0.6, 0.9
"""Exponents of the blade's width at its base and at its tip."""
MIDRIB, VEIN = 0.8e-3, 0.35e-3
"""Heights of midrib and veins on the lower side, m; on the upper side they are half as high."""
RIB = 1e-3
"""Distance from the middle of a rib at which its height has fallen to 1/e, m."""
VEINS = 7
"""Number of side veins on each side of the midrib."""
WAVES = 4
"""Number of waves, 5 to 12 cm long, whose sum is the undulation."""
STRAIGHT = 1e-4
"""Bend below which a blade counts as flat, rad."""
STEP = 1e-6
"""Step of the difference quotients for directions, m; these err by about 1e-9."""


@dataclass(frozen=True, eq=False)
class Blade:
    """A blade, its stalk included.

    Attributes:
        length, width, thickness (m): Without stalk and ribs.
        curl (rad): Bend from edge to edge; above 0 towards its upper side.
        bend (rad): Bend from base to tip; above 0 away from its upper side.
        amplitude (m): Amplitude of each wave.
        waves ((3, WAVES), rad/m, rad/m and rad): Wave numbers along and across, and phases.
        veins (2, VEINS): Starts of the side veins of either side, as fractions of the length.
    """

    length: float
    width: float
    thickness: float
    curl: float
    bend: float
    amplitude: float
    waves: Values
    veins: Values

    @classmethod
    def drawn(
        cls,
        seed: int,
        *,
        length: float,
        width: float,
        thickness: float,
        curl: float,
        bend: float,
        undulation: float,
    ) -> Blade:
        """Draw waves, of a root mean square (m), and veins from a seed."""
        random = np.random.default_rng([seed, 0])
        direction, phase = random.uniform(0.0, 2.0 * np.pi, (2, WAVES))
        number = 2.0 * np.pi / random.uniform(0.05, 0.12, WAVES)
        waves = np.stack([number * np.cos(direction), number * np.sin(direction), phase])
        spread = (np.arange(VEINS) + random.uniform(0.35, 0.65, (2, VEINS))) / VEINS
        amplitude = undulation * float(np.sqrt(2.0 / WAVES))
        return cls(length, width, thickness, curl, bend, amplitude, waves, 0.04 + 0.78 * spread)

    def half_width(self, along: Values) -> Values:
        """Return how far the blade or its stalk reaches to either side, in m."""
        share = np.clip(along / self.length + 0.5, 0.0, 1.0)
        widest = ROUND / (ROUND + POINTED)
        greatest = widest**ROUND * (1.0 - widest) ** POINTED
        blade = 0.5 * self.width * share**ROUND * (1.0 - share) ** POINTED / greatest
        stalk = np.where(along < 0.0, PETIOLE, 0.0)
        half: Values = np.maximum(blade, stalk)
        return half

    @property
    def outline(self) -> Outline:
        """Over the places along it."""
        turn = np.linspace(0.0, np.pi, 400)
        # Denser at both ends, where the width changes fast.
        along = np.concatenate(
            [[-0.5 * self.length - PETIOLE_LENGTH], -0.5 * self.length * np.cos(turn)]
        )
        half = self.half_width(along)
        return Outline(along, -half, half)

    def placed(self, along: Values, across: Values, height: Values) -> Values:
        """Return the points (N, 3) m of places (N,) m and heights (N,) m above the bare blade."""
        # Towards the side that the curl hollows, and the bend about an axis along y.
        angle, reach = self._angle(across, self.curl, self.width), height
        y = across * np.sinc(angle / np.pi) - reach * np.sin(angle)
        x = across * np.sin(angle / 2.0) * np.sinc(angle / (2.0 * np.pi)) + reach * np.cos(angle)
        angle = self._angle(along, self.bend, self.length)
        back = along * np.sin(angle / 2.0) * np.sinc(angle / (2.0 * np.pi))
        z = along * np.sinc(angle / np.pi) + x * np.sin(angle)
        return np.stack([x * np.cos(angle) - back, y, z], axis=-1)

    @staticmethod
    def _angle(at: Values, total: float, over: float) -> Values:
        return at * (total / over if abs(total) > STRAIGHT else 0.0)

    def unplaced(self, points: Values) -> tuple[Values, Values, Values]:
        """Return places along and across and heights of points (N, 3) m: `placed` undone."""
        x, y, z = points.T
        along, across = z, y
        if abs(self.bend) > STRAIGHT:
            radius = self.length / self.bend
            sign = np.sign(radius)
            along = radius * np.arctan2(sign * z, sign * (x + radius))
            x = sign * np.hypot(x + radius, z) - radius
        if abs(self.curl) > STRAIGHT:
            radius = self.width / self.curl
            sign = np.sign(radius)
            across = radius * np.arctan2(sign * y, sign * (radius - x))
            x = radius - sign * np.hypot(radius - x, y)
        return along, across, x

    def undulation(self, along: Values, across: Values) -> Values:
        """Return how high the waves are, in m; 0 in the middle."""
        phase = np.multiply.outer(along, self.waves[0]) + np.multiply.outer(across, self.waves[1])
        waves: Values = np.cos(phase + self.waves[2]) - np.cos(self.waves[2])
        total: Values = waves.sum(axis=-1)
        return self.amplitude * total

    def ribs(self, along: Values, across: Values) -> Values:
        """Return how much midrib and veins stand out from the lower side, in m."""
        share = np.clip(along / self.length + 0.5, 0.0, 1.0)
        # The midrib goes on as the stalk, whose end is no thicker than the blade.
        end = np.clip((along + 0.5 * self.length + PETIOLE_LENGTH) / RIB, 0.0, 1.0)
        height = end * MIDRIB * (1.0 - 0.9 * share) * np.exp(-((across / RIB) ** 2))
        half = self.half_width(along)
        taper = np.clip(1.0 - np.abs(across) / half.clip(min=1e-9), 0.0, None)
        for side, starts in zip((-1.0, 1.0), self.veins, strict=True):
            out = side * across
            # Veins leave the midrib at 50 degrees and turn towards the tip.
            ahead = 0.84 * out + 0.5 * out**2 / (0.5 * self.width)
            steep = np.hypot(1.0, 0.84 + 2.0 * out / self.width)
            # Nothing at the midrib itself, where the veins of both sides would not fit together.
            leaving = VEIN * taper * np.where(out > 0.0, -np.expm1(-((out / RIB) ** 2)), 0.0)
            for start in starts:
                off = (along - (start - 0.5) * self.length - ahead) / steep
                height += leaving * np.exp(-((off / RIB) ** 2))
        return height

    def upper(self, along: Values, across: Values) -> Values:
        """Return the points (N, 3) m of the upper side."""
        return self.placed(along, across, self._upper_height(along, across))

    def lower(self, along: Values, across: Values) -> Values:
        """Return the points (N, 3) m of the lower side."""
        height = self.undulation(along, across) - 0.5 * self.thickness
        return self.placed(along, across, height - self.ribs(along, across))

    def _upper_height(self, along: Values, across: Values) -> Values:
        ribs = 0.5 * self.ribs(along, across)
        return self.undulation(along, across) + 0.5 * self.thickness + ribs

    def clearance(self, points: Values) -> Values:
        """Return how high points (N, 3) m are above the upper side, beyond its edge continued."""
        along, across, height = self.unplaced(points)
        return height - self._upper_height(along, across)

    def frames(self, along: Values, across: Values) -> tuple[Values, Values, Values]:
        """Return where one stands on the upper side, passing over the ribs.

        Args:
            along, across ((N,), m): Places.

        Returns:
            points ((N, 3), m): On the upper side.
            normals (N, 3): Unit vectors away from the leaf.
            tangents (N, 3): Unit vectors along the length, towards the tip.
        """

        def smooth(u: Values, v: Values) -> Values:
            return self.placed(u, v, self.undulation(u, v) + 0.5 * self.thickness)

        tangents = smooth(along + STEP, across) - smooth(along - STEP, across)
        aside = smooth(along, across + STEP) - smooth(along, across - STEP)
        normals = np.cross(aside, tangents)
        return smooth(along, across), _unit(normals), _unit(tangents)

    def stretch(self) -> float:
        """Return by how much lengths on the flat blade grow at most where it is bent."""
        slope = self.amplitude * float(np.hypot(*self.waves[:2]).sum())
        angle = min(abs(self.curl) / 2.0, np.pi / 2.0)
        hollow = 0.5 * self.width * np.sin(angle / 2.0) * np.sinc(angle / (2.0 * np.pi))
        wavy = 2.0 * WAVES * self.amplitude + 0.5 * self.thickness + MIDRIB
        bent = 1.0 + (hollow + wavy) * abs(self.bend) / self.length
        curled = 1.0 + wavy * abs(self.curl) / self.width
        return float(max(bent, curled) * np.hypot(1.0, slope))


def _unit(vectors: Values) -> Values:
    unit: Values = vectors / np.linalg.norm(vectors, axis=-1, keepdims=True)
    return unit
