# SPDX-License-Identifier: MIT
"""Which hits of rays can be heard, and which bundles of rays are too coarse."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from sononerf.simulation.paths import Bounce

RESOLVED_FREQUENCY = 80e3
"""Frequency at which a bundle must resolve the surface, Hz; near the top of the default band."""
RESOLVED = 1.0
"""Bend of the path over a bundle up to which a mirror point in it is resolved, rad."""
NEAR = 4.0
"""Phase from a bundle to a mirror point up to which the point counts, rad; it has e^-4 there."""
REACHED = 1.0
"""Distance from the middle of a bundle to a mirror point of its own, sides of the bundle."""
WIDE = 5e-4
"""Width of a bundle, m, above which it may hold a mirror point of the next bounce that its ray does
not show."""
EXPLORE = 0.1
"""What such a bundle may bring, as a fraction of what one with a mirror point brings."""
EARS_APART = 0.03
"""Distance between receivers, m, up to which the middle between them stands for each of them."""


def row_dot(a: NDArray[np.float64], b: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return the dot products (N,) of rows (N, 3)."""
    product: NDArray[np.float64] = np.einsum("nd,nd->n", a, b)
    return product


@dataclass(frozen=True)
class Audibility:
    """Judges the hits of a bounce.

    Attributes
    ----------
    wavenumber : float, rad/m
        At the frequency that bundles must resolve.
    farthest : float, m
        Longest detour that is heard.
    radius : float, m
        Of the scene.
    bounces : int
        How often a ray may hit.
    """

    wavenumber: float
    farthest: float
    radius: float
    bounces: int

    def judge_all(
        self, bounce: Bounce, listeners: NDArray[np.float64]
    ) -> tuple[NDArray[np.bool_], NDArray[np.float64]]:
        """Which hits some listener can hear (H,), and by how much each (H,) may be wrong."""
        audible, doubt = self._judge(bounce, listeners[0])
        for place in listeners[1:]:
            also, more = self._judge(bounce, place)
            audible |= also
            np.maximum(doubt, more, out=doubt)
        return audible, doubt

    def _judge(
        self, bounce: Bounce, listener: NDArray[np.float64]
    ) -> tuple[NDArray[np.bool_], NDArray[np.float64]]:
        """Which hits can be heard (H,), and by how much each (H,) may be wrong."""
        away = listener - bounce.points
        distance = np.sqrt(row_dot(away, away))
        away /= distance[:, None]
        rise, detour, _, stiffness = bounce.detour(away, distance)
        # Seen from an ear either may be somewhat different from the middle between the ears.
        facing = rise * distance > -EARS_APART
        audible = facing & (detour < 1.25 * self.farthest)
        k = np.float32(self.wavenumber)
        side = np.sqrt(bounce.solid_angle)
        # Counted in turns of the ray at the emitter, the mirror point is this far from the cell.
        off = np.sqrt(2.0 * detour / np.maximum(stiffness, np.float32(1e-12))) - REACHED * side
        least = 0.5 * stiffness * np.square(np.maximum(off, 0.0))
        turns = k * stiffness * side**2
        coarse = facing & (turns > RESOLVED) & (k * least < NEAR)
        width = np.sqrt(bounce.footprint.tube)
        level = np.float32(bounce.solid_angle) * width
        doubt = np.zeros(len(level))
        chosen = np.flatnonzero(coarse)
        doubt[chosen] = level[chosen] / distance[chosen] * np.exp(-k * least[chosen])
        doubt[chosen] *= np.minimum(turns[chosen], 10.0)
        if 1 < bounce.number < self.bounces:
            # What goes on from here may be heard, however it looks from the head.
            wide = side * width > WIDE
            np.maximum(doubt, np.where(wide, EXPLORE / self.radius * level, 0.0), out=doubt)
        return audible, doubt
