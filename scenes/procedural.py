# SPDX-License-Identifier: MIT
"""One of many shapes by its seed: for measuring over more than a few chosen scenes."""

from __future__ import annotations

from typing import Annotated

import numpy as np
import trimesh
from numpy.typing import NDArray
from pydantic import Field

from sononerf.geometry.poses import rotation_from_euler
from sononerf.scene import MATERIALS, MaterialName, Scene

from .bodies import placed
from .box import box
from .capsule import capsule
from .cluster import GAP, cluster
from .letters import FONT, letters
from .torus import torus

KINDS = ("cluster", "box", "torus", "capsules", "letters")


def procedural(
    seed: Annotated[int, Field(ge=0, lt=2**32)] = 0, material: MaterialName = "rigid"
) -> Scene:
    """Build a shape from a seed: cluster, box, torus, capsules or letters by its rest over 5.

    Sizes, proportions and orientation are drawn; it is about 6 to 20 cm across.
    """
    kind = seed % len(KINDS)
    random = np.random.default_rng([seed, kind])
    turn = _turn(random)
    if KINDS[kind] == "cluster":
        count, spread = int(random.integers(3, 8)), random.uniform(0.06, 0.09)
        return cluster(seed, count, 0.01, 0.02, spread, material)
    if KINDS[kind] == "box":
        longest = random.uniform(0.06, 0.12)
        second, third = longest * random.uniform(0.4, 1.0, 2)
        return box((longest, second, third), *turn, material)
    if KINDS[kind] == "torus":
        radius = random.uniform(0.028, 0.06)
        return torus(radius, radius * random.uniform(0.22, 0.45), *turn, material)
    if KINDS[kind] == "capsules":
        return _capsules(1 + seed // len(KINDS) % 3, random, material)
    text = "".join(random.choice([letter for letter in FONT if letter.isalpha()], 2))
    height, stroke = random.uniform(0.07, 0.11), random.uniform(0.07, 0.1)
    return letters(text, height, stroke, *turn, material)


def _turn(random: np.random.Generator) -> tuple[float, float, float]:
    """Draw yaw, pitch and roll (degrees), uniformly over all orientations."""
    yaw, roll = random.uniform(-180.0, 180.0, 2)
    return yaw, float(np.degrees(np.arcsin(random.uniform(-1.0, 1.0)))), roll


def _capsules(count: int, random: np.random.Generator, material: MaterialName) -> Scene:
    """Build capsules that do not touch, within a ball of a radius of 9 cm."""
    bodies: list[trimesh.Trimesh] = []
    axes: list[tuple[NDArray[np.float64], float]] = []  # points (100, 3) m, and the radius
    while len(bodies) < count:
        length, radius = random.uniform(0.04, 0.1), random.uniform(0.01, 0.02)
        turn, centre = _turn(random), random.uniform(-0.05, 0.05, 3)
        upright = rotation_from_euler(*np.radians(turn))[:, 2]
        axis = centre + np.linspace(-length / 2.0, length / 2.0, 100)[:, None] * upright
        apart = all(
            np.linalg.norm(axis[:, None] - other, axis=-1).min() >= radius + other_radius + GAP
            for other, other_radius in axes
        )
        if apart and np.linalg.norm(axis, axis=1).max() + radius <= 0.09:
            body = capsule(length, radius, *turn).mesh
            bodies.append(body.apply_translation(centre))
            axes.append((axis, radius))
    return Scene(placed(trimesh.util.concatenate(bodies)), MATERIALS[material])
