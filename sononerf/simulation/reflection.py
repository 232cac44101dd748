# SPDX-License-Identifier: MIT
"""Reflection: a lobe about the mirror direction, its strength, and the remainder that continues."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from sononerf.numerics import Complexes, Floats, Singles, compiled
from sononerf.scene.material import Material

COARSEST = 10.0  # rad
LEAST_RISE = 1e-4  # sine of the angle below which sound grazes a surface
# Beyond this many standard deviations a lobe is 3e-4 of its middle (-70 dB) and left out.
REACH = 4.0
# A smooth surface sends sound where its shape does: Kirchhoff's integral over it, which lives from
# the first Fresnel zones about the mirror point. Places farther away fade by this much per radian
# of phase; by itself it would cancel, up to false echoes from the border of light and shadow and
# the noise of rays that are too few for it.
FADE = 1.0
# Well below this the fade is no slower, so that places far from the mirror point need not be
# followed.
FADE_FREQUENCY = 25e3  # Hz


@dataclass(frozen=True, eq=False)
class Reflection:
    """A material at the frequencies of a simulation."""

    fade: Floats  # (F,), 1/m: Decay of a smooth surface over the detour from the mirror's path
    lobe_width: Floats  # (F,), rad: Standard deviation of the lobe; of a smooth surface, not used
    strength: Floats  # (F,), 1: Strengths of what is heard of a hit
    kept: Floats  # (F,), 1: Pressure after a bounce, over that before it
    curved_lobe_width: Floats  # (F,): The same where the surface is strongly curved
    curved_strength: Floats
    # (F,), 1: Strength of edges and strongly curved places as sources of their own
    diffraction: Floats
    material: Material  # Material of these values

    def curved_share(self, curvature: Floats) -> Floats:
        """Return how curved places are, 0 to 1, by their total curvature (N,) in 1/m."""
        steepness = 8.0 * self.material.transition_slope
        away = steepness * (curvature - self.material.transition_curvature)
        return 0.5 * (1.0 + np.tanh(0.5 * away))

    def heard(
        self, cosine: Floats, detour: NDArray[np.floating[Any]], curvature: Floats
    ) -> NDArray[np.floating[Any]]:
        r"""Lobe times strength.

        The echo of a smooth surface fades by :math:`e^{-\epsilon k \delta}` with the detour
        :math:`\delta`; :func:`unfaded` compensates the loss.

        In: cosine (N,), detour ((N,), m), curvature ((N,), 1/m). Out: gain (N, F).
        """
        strength = self.strength
        share = None
        if self.material.mixed:
            share = self.curved_share(curvature)[:, None]
            strength = strength + share * (self.curved_strength - strength)
        gain: NDArray[np.floating[Any]]
        if self.material.lobe_width is None:
            gain = np.exp(np.multiply.outer(detour, -self.fade.astype(np.float32)))
        else:
            width = self.lobe_width
            if share is not None:
                width = width + share * (self.curved_lobe_width - width)
            gain = np.exp(lobe_exponent(cosine, width))
        gain *= strength
        return gain

    @property
    def reach(self) -> float:
        """Angle off the mirror direction beyond which nothing is heard, rad."""
        if self.material.lobe_width is None:
            return math.pi
        widest = float(self.lobe_width.max())
        if self.material.mixed:
            widest = max(widest, float(self.curved_lobe_width.max()))
        return min(REACH * widest, float(np.pi))


def reflection(material: Material, frequency: ArrayLike, *, speed_of_sound: float) -> Reflection:
    """Return a material's values at frequencies (F,) in Hz, straight over their logarithm."""
    log_frequency, nodes = np.log(np.asarray(frequency)), np.log(material.frequency)

    def at(*curves: tuple[float, ...] | None) -> Floats:
        given = next((curve for curve in curves if curve is not None), (0.0,) * len(nodes))
        return np.interp(log_frequency, nodes, given)

    fade, _ = unfaded(np.asarray(frequency, dtype=np.float64), speed_of_sound=speed_of_sound)
    return Reflection(
        fade,
        at(material.lobe_width),
        at(material.strength),
        at(material.reflection),
        at(material.curved_lobe_width, material.lobe_width),
        at(material.curved_strength, material.strength),
        at(material.diffraction),
        material,
    )


def unfaded(frequency: Floats, *, speed_of_sound: float) -> tuple[Floats, Complexes]:
    r"""Return the fade of smooth surfaces, and the gain that compensates it.

    Faded, Kirchhoff's integral over the Fresnel zones is
    :math:`\int e^{-(\epsilon + j) k \delta} d\delta = 1 / (\epsilon + j) k` in place of
    :math:`1 / j k`, at all curvatures; the factor :math:`1 - j \epsilon` is the same everywhere.

    In: frequency ((F,), Hz), speed_of_sound (m/s). Out: fade ((F,), 1/m), gain ((F,) complex128,
    Hz).
    """
    faded = FADE * np.hypot(frequency, FADE_FREQUENCY)
    gain = (1j * frequency + faded).astype(np.complex128)
    return 2.0 * math.pi / speed_of_sound * faded, gain


def coarse_gain(bend: Singles) -> Singles:
    r"""Return the gain that compensates the mean loss of a smooth surface by coarse cells.

    A cell is laid into time bins as wide as its paths are spread, by the slope of the path over it
    and by its bend :math:`b = k \lambda \Omega`, :math:`\lambda` the Hessian's eigenvalue. Over
    all places of a mirror point among the cells the slope's spread acts as a further fade by
    :math:`b / 12`, and the bend's as a loss of :math:`e^{-b^2 / 720}`: variances over a square.

    In: bend ((N, F) float32, rad). Out: gain ((N, F) float32).
    """
    b = np.minimum(bend, np.float32(COARSEST))
    fade = np.square(np.float32(FADE) + b / np.float32(12.0)) + np.float32(1.0)
    fade /= np.float32(FADE**2 + 1.0)
    return np.sqrt(fade) * np.exp(np.square(b) / np.float32(720.0))


@compiled
def leave(directions: Floats, flat: Floats, points: Floats, lift: float) -> tuple[Floats, Floats]:
    """Start rays off the surface, turned so far that those which run into it graze it.

    A mirror direction about a smooth normal may point into the flat triangle that was hit.

    In: directions (N, 3), flat (N, 3), points ((N, 3), m), lift (m). Out: origins ((N, 3), m),
    directions (N, 3).
    """
    origins, onward = np.zeros((len(points), 3)), np.zeros((len(points), 3))
    for i in range(len(points)):
        rise = 0.0
        for k in range(3):
            rise += directions[i, k] * flat[i, k]
        more = max(LEAST_RISE - rise, 0.0)
        length = 0.0
        for k in range(3):
            origins[i, k] = points[i, k] + lift * flat[i, k]
            onward[i, k] = directions[i, k] + more * flat[i, k]
            length += onward[i, k] * onward[i, k]
        if more > 0.0:
            length = math.sqrt(length)
            for k in range(3):
                onward[i, k] /= length
    return origins, onward


def lobe_exponent(cosine: Floats, lobe_width: Floats) -> Floats:
    """Logarithm of the lobe, ``-theta**2 / (2 w**2)``.

    In: cosine (N,), lobe_width ((F,) or (N, F), rad). Out: exponent (N, F).
    """
    theta = np.arccos(np.clip(cosine, -1.0, 1.0))
    return -0.5 * np.square(theta)[:, None] / np.square(lobe_width)
