# SPDX-License-Identifier: MIT
"""Whether two surfaces cut through one another."""

from __future__ import annotations

import numpy as np
import trimesh
from numpy.typing import NDArray

from sononerf.geometry.raycast import RayCaster


def surfaces_cross(one: trimesh.Trimesh, other: trimesh.Trimesh) -> bool:
    """Whether two surfaces cut through one another.

    Where triangles meet, an edge of one of them passes through the other; so all edges of each
    surface are tried against the other one.

    Parameters
    ----------
    one, other : Trimesh
        Metres, world frame.

    Returns
    -------
    cross : bool
        False also where one lies wholly inside the other. Surfaces that touch may be taken for
        either, as single precision has it.
    """
    low = np.maximum(one.bounds[0], other.bounds[0])
    high = np.minimum(one.bounds[1], other.bounds[1])
    if (low > high).any():
        return False
    near = [_within(mesh, low, high) for mesh in (one, other)]
    if not all(len(mesh.faces) for mesh in near):
        return False
    return _pierces(near[0], near[1]) or _pierces(near[1], near[0])


def _within(
    mesh: trimesh.Trimesh, low: NDArray[np.float64], high: NDArray[np.float64]
) -> trimesh.Trimesh:
    """Return the triangles whose bounding boxes reach into a box."""
    vertices, faces = np.asarray(mesh.vertices), np.asarray(mesh.faces)
    corners = vertices[faces]
    reach = (corners.min(axis=1) <= high) & (corners.max(axis=1) >= low)
    return trimesh.Trimesh(vertices, faces[reach.all(axis=1)], process=False, validate=False)


def _pierces(edged: trimesh.Trimesh, faced: trimesh.Trimesh) -> bool:
    faces = np.asarray(edged.faces)
    ends = np.unique(np.sort(faces[:, [[0, 1], [1, 2], [2, 0]]].reshape(-1, 2), axis=1), axis=0)
    start, end = np.asarray(edged.vertices)[ends.T]
    return not RayCaster(faced).visible(start, end).all()
