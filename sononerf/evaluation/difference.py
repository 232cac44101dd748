# SPDX-License-Identifier: MIT
"""Differences between two runs, or between two true surfaces."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import trimesh
from scipy.spatial import cKDTree

from sononerf.array_types import Floats
from sononerf.errors import NumericalError
from sononerf.surface.start.volume import Volume

SAME = 1e-6
"""Largest distance between the centroids of two triangles that count as the same, m."""


@dataclass(frozen=True, eq=False)
class Comparison:
    """Two volumes over their common maximum, and the difference between them.

    Attributes:
        first, second: 0 to 1, on one grid.
        difference: First without second.
        strongest ((3,) or None, m): Place of the greatest difference; None where it is nowhere
            above zero.
        score: Greatest difference, as a fraction of the common maximum.
        poses: At how many poses both were heard.
    """

    first: Volume
    second: Volume
    difference: Volume
    strongest: Floats | None
    score: float
    poses: int = 0


def compare(first: Volume, second: Volume) -> Comparison:
    """Compare two volumes, place by place.

    Args:
        first, second: Loudness of each place, on one grid.

    Raises:
        ValueError: If the grids differ.
        NumericalError: If both are silent.
    """
    alike = first.shape == second.shape and np.allclose(first.origin, second.origin)
    if not alike or first.spacing != second.spacing:
        raise ValueError("the two volumes have different grids")
    most = max(float(first.values.max()), float(second.values.max()))
    if not most > 0:
        raise NumericalError("nothing to compare: both are silent")
    one, other = (volume.with_values(volume.values / most) for volume in (first, second))
    difference = first.with_values(one.values - other.values)
    index = np.unravel_index(int(difference.values.argmax()), difference.shape)
    score = float(difference.values[index])
    # Where nothing is stronger the greatest value lies anywhere, often in a corner.
    strongest = difference.origin + difference.spacing * np.array(index) if score > 0 else None
    return Comparison(one, other, difference, strongest, score)


def added_part(mesh: trimesh.Trimesh, without: trimesh.Trimesh) -> trimesh.Trimesh | None:
    """Return the parts of a true surface that another one lacks; None if there are none."""
    if not len(without.faces):
        return mesh
    distance, _ = cKDTree(without.triangles_center).query(mesh.triangles_center)
    added = np.flatnonzero(distance > SAME)
    return mesh.submesh([added], append=True) if len(added) else None
