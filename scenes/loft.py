# SPDX-License-Identifier: MIT
"""Round bodies along a line in space, thick and thin: limbs, trunks, twigs."""

from __future__ import annotations

import itertools
import math

import numpy as np
import trimesh
from numpy.typing import ArrayLike, NDArray

from .bodies import SIDE, sections, walls


def loft(path: ArrayLike, radius: ArrayLike) -> trimesh.Trimesh:
    """Build a body of circular section along a line.

    Args:
        path ((N, 3), m): Points of the line, at least three, no two that follow one another the
            same. It must not bend more sharply than the body is thick.
        radius ((N,), m): Radii of the circles about them. Both ends are points, their radii are not
            asked for.

    Returns:
        body: Closed, facing outward.
    """
    points, radii = np.asarray(path, np.float64), np.asarray(radius, np.float64)
    along = np.gradient(points, axis=0)
    along /= np.linalg.norm(along, axis=1, keepdims=True)
    count = sections(2.0 * np.pi * float(radii[1:-1].max()))
    around = 2.0 * np.pi * np.arange(count) / count
    rings = [
        points[index]
        + radii[index] * (np.outer(np.cos(around), aside) + np.outer(np.sin(around), above))
        for index, (aside, above) in enumerate(_frames(along))
    ][1:-1]
    size = len(rings) * count
    ring, last = np.arange(count), size - count
    beside = np.roll(ring, -1)
    caps = [(np.full(count, size), beside, ring), (np.full(count, size + 1), last + ring)]
    faces = np.concatenate(
        [
            walls(len(rings), count, False),
            np.stack(caps[0], axis=1),
            np.stack((*caps[1], last + beside), axis=1),
        ]
    )
    return trimesh.Trimesh(np.concatenate([*rings, points[[0, -1]]]), faces, process=False)


def _frames(along: NDArray[np.float64]) -> list[tuple[NDArray[np.float64], NDArray[np.float64]]]:
    """Return two directions square to each of the line's, which do not spin about it."""
    aside = np.eye(3)[np.argmin(np.abs(along[0]))]
    frames = []
    for direction in along:
        aside = aside - (aside @ direction) * direction
        aside = aside / np.linalg.norm(aside)
        frames.append((aside, np.cross(direction, aside)))
    return frames


def evenly(corners: ArrayLike, step: float = SIDE) -> NDArray[np.float64]:
    """Return points along a line with corners (K, 3) m, a step (m) apart at most; keep those."""
    given = np.asarray(corners, np.float64)
    pieces = []
    for start, end in itertools.pairwise(given):
        count = max(1, math.ceil(float(np.linalg.norm(end - start)) / step))
        share = np.arange(count)[:, None] / count
        pieces.append(start + share * (end - start))
    return np.concatenate([*pieces, given[-1:]])
