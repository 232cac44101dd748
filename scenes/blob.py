# SPDX-License-Identifier: MIT
"""A smooth body without any symmetry, drawn from a seed."""

from __future__ import annotations

import math
from typing import Annotated

import numpy as np
import trimesh
from numpy.polynomial.legendre import legval
from numpy.typing import NDArray
from pydantic import Field

from sononerf.scene import MATERIALS, MaterialName, Scene

from .bodies import EDGE, SIDE, Degrees, placed
from .lathe import lathe

DEGREES = (2, 3, 4, 5)
"""Degrees of the spherical harmonics that are added: from an ellipsoid to bumps of 36 degrees."""
MARGIN = 1.02
"""Margin by which the next mesh is finer than the last one shows to be needed."""

BlobRadius = Annotated[float, Field(gt=0, le=0.15)]
"""In m."""
Roughness = Annotated[float, Field(ge=0, le=0.3)]
"""Standard deviation of the logarithm of the distance from the centre, over all directions."""


def blob(
    seed: Annotated[int, Field(ge=0, lt=2**32)] = 0,
    radius: BlobRadius = 0.045,
    roughness: Roughness = 0.15,
    yaw: Degrees = 0.0,
    pitch: Degrees = 0.0,
    roll: Degrees = 0.0,
    material: MaterialName = "rigid",
) -> Scene:
    """Build a smooth body from a seed, with the volume of a ball of a radius (m).

    It is turned by yaw, pitch and roll (degrees).
    """
    surface = _Surface(np.random.default_rng([seed, 0]), roughness)
    # Directions are even on a ball; it is made larger until triangles of the blob are fine.
    size = radius
    for _ in range(3):
        mesh = _sphere(size)
        mesh.vertices *= surface.distance(np.asarray(mesh.vertices))[:, None]
        mesh.apply_scale(radius * (4.0 / 3.0 * math.pi / mesh.volume) ** (1.0 / 3.0))
        longest = float(mesh.edges_unique_length.max())
        if longest <= EDGE:
            break
        size *= longest / EDGE * MARGIN
    return Scene(placed(mesh, yaw, pitch, roll), MATERIALS[material])


def _sphere(size: float) -> trimesh.Trimesh:
    """Build a unit sphere, as fine as one of a radius (m) would be."""
    count = max(12, math.ceil(math.pi * size / SIDE))
    angle = np.pi * np.arange(count + 1) / count
    profile = np.stack([size * np.sin(angle), -size * np.cos(angle)], axis=1)
    profile[[0, -1], 0] = 0.0
    return lathe(profile).apply_scale(1.0 / size)


class _Surface:
    """How far a surface is from the origin, over all directions; the mean is about 1.

    Args:
        random: Draws the bumps.
        roughness: Standard deviation of the logarithm of the distance.
    """

    def __init__(self, random: np.random.Generator, roughness: float) -> None:
        self.roughness = roughness
        self.axes, self.weights = [], []
        for degree in DEGREES:
            # Legendre polynomials about 2 n + 1 axes span the spherical harmonics of degree n.
            axes = random.standard_normal((2 * degree + 1, 3))
            self.axes.append(axes / np.linalg.norm(axes, axis=1, keepdims=True))
            self.weights.append(random.standard_normal(2 * degree + 1) / degree)
        even = trimesh.creation.icosphere(subdivisions=4).vertices
        logarithm = self._sum(np.asarray(even))
        self.mean, self.deviation = float(logarithm.mean()), float(logarithm.std())

    def distance(self, directions: NDArray[np.float64]) -> NDArray[np.float64]:
        """Return the distance (N,) along unit vectors (N, 3)."""
        logarithm = (self._sum(directions) - self.mean) / self.deviation
        return np.asarray(np.exp(self.roughness * logarithm), dtype=np.float64)

    def _sum(self, directions: NDArray[np.float64]) -> NDArray[np.float64]:
        total = np.zeros(len(directions))
        for degree, axes, weights in zip(DEGREES, self.axes, self.weights, strict=True):
            total += legval(directions @ axes.T, np.eye(degree + 1)[degree]) @ weights
        return total
