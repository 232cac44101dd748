# SPDX-License-Identifier: MIT
"""Bodies of revolution out of even triangles, flat faces and tips included."""

from __future__ import annotations

import math

import numpy as np
import trimesh
from numpy.typing import ArrayLike, NDArray

from .bodies import SIDE, sections
from .loft import evenly


def lathe(profile: ArrayLike) -> trimesh.Trimesh:
    """Turn a profile about the z axis.

    Circles of the profile are divided by their own length, so triangles are as large near the axis
    as far from it.

    Args:
        profile ((N, 2), m): Radius and height of corners, with straight lines between them. The
            outside lies to the right of the way from the first corner to the last, as on a way up
            an outer wall. An end at radius zero is closed by a tip; any other end leaves a hole.

    Returns:
        body: Facing outward; vertices circle by circle, in the order of the profile.
    """
    corners = np.insert(np.asarray(profile, np.float64), 1, 0.0, axis=1)
    rows = evenly(corners, SIDE)[:, [0, 2]]
    counts = [sections(2.0 * math.pi * radius) if radius > 0.0 else 1 for radius, _ in rows]
    starts = np.cumsum([0, *counts])
    circles = []
    for (radius, height), count in zip(rows, counts, strict=True):
        angle = 2.0 * np.pi * np.arange(count) / count
        x, y = radius * np.cos(angle), radius * np.sin(angle)
        circles.append(np.stack([x, y, np.full(count, height)], axis=1))
    strips = [
        _strip(starts[row], counts[row], starts[row + 1], counts[row + 1])
        for row in range(len(rows) - 1)
    ]
    return trimesh.Trimesh(np.concatenate(circles), np.concatenate(strips), process=False)


def _strip(low: int, low_count: int, high: int, high_count: int) -> NDArray[np.int64]:
    """Return triangles (T, 3) between two circles, from their first vertices and their counts.

    The strip is walked once round; each side of either circle makes one triangle with the vertex
    that the walk has reached on the other circle.
    """
    one, other = np.arange(low_count), np.arange(high_count)
    low_at, high_at = (one + 0.5) / low_count, (other + 0.5) / high_count
    reached_high = np.searchsorted(high_at, low_at, side="left") % high_count
    reached_low = np.searchsorted(low_at, high_at, side="right") % low_count
    low_next, high_next = (one + 1) % low_count, (other + 1) % high_count
    strips = []
    if low_count > 1:
        strips.append(np.stack([low + one, low + low_next, high + reached_high], axis=1))
    if high_count > 1:
        strips.append(np.stack([low + reached_low, high + high_next, high + other], axis=1))
    return np.concatenate(strips).astype(np.int64)
