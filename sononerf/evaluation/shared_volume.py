# SPDX-License-Identifier: MIT
"""How much space solids take, and how much of it they share."""

from __future__ import annotations

import numpy as np
import trimesh
from numpy.typing import NDArray

from sononerf.evaluation.layered_depth import crossings, inside_intervals
from sononerf.evaluation.solid import Solid

# Lines across the bounding box on each axis: true to 1e-4 of a ball's volume.
LINES = 401

Stretches = tuple[NDArray[np.intp], NDArray[np.float64], NDArray[np.float64]]


def volumes(first: Solid, second: Solid) -> tuple[float, float, float]:
    """Return the volumes of two unions and of what they share, in m³.

    Exact lengths along 401 x 401 parallel lines across the bounding box.
    """
    both = [trimesh.util.concatenate(solid.bodies) for solid in (first, second)]
    low = np.min([mesh.bounds[0] for mesh in both], axis=0)
    high = np.max([mesh.bounds[1] for mesh in both], axis=0)
    step = (high - low)[1:] / LINES
    rows, columns = (low[axis] + step[axis - 1] * (np.arange(LINES) + 0.5) for axis in (1, 2))
    stretches = [
        inside_intervals(
            crossings(np.asarray(mesh.vertices), np.asarray(mesh.faces), rows, columns)
        )
        for mesh in both
    ]
    cell = float(step[0] * step[1])
    one, two = (cell * float((stop - start).sum()) for _, start, stop in stretches)
    return one, two, cell * _shared_length(*stretches)


def _shared_length(first: Stretches, second: Stretches) -> float:
    """Return the total length that lies in a stretch of both."""
    line = np.concatenate([first[0], first[0], second[0], second[0]])
    depth = np.concatenate([first[1], first[2], second[1], second[2]])
    change = np.concatenate(
        [sign * np.ones(len(part[0])) for part in (first, second) for sign in (1, -1)]
    )
    order = np.lexsort((depth, line))
    level = np.cumsum(change[order])[:-1]
    gaps = np.diff(depth[order])
    # Stretches of one solid never overlap, so a level of two means that both are there.
    return float(gaps[level > 1.5].sum())
