# SPDX-License-Identifier: MIT
"""The surface between the vertices: normals that know a round body from an edge."""

from __future__ import annotations

import math

import numpy as np
import trimesh
from numpy.typing import NDArray
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components

CREASE = math.radians(30.0)


def corner_normals(mesh: trimesh.Trimesh, *, crease: float = CREASE) -> NDArray[np.float64]:
    """Smooth normal at each corner of each triangle.

    Around a vertex, triangles are taken together as far as their neighbours meet at less than
    the crease angle, so a sphere is smooth and a box keeps its edges. The weights are those of
    Max [1]_: exact wherever a vertex and its neighbours lie on one sphere.

    Parameters
    ----------
    mesh : trimesh.Trimesh
        With shared vertices.
    crease : float, rad
        Triangles that meet at a greater angle do not share a normal.

    Returns
    -------
    normals : (T, 3, 3) float64
        Unit vectors, outward where the mesh is; of a triangle without area, zero.

    References
    ----------
    .. [1] N. Max, "Weights for computing vertex normals from facet normals", Journal of
       Graphics Tools 4(2), 1999.
    """
    faces = np.asarray(mesh.faces)
    corners = mesh.vertices.view(np.ndarray)[faces]  # (T, 3, 3)
    ahead = np.roll(corners, -1, axis=1) - corners
    behind = np.roll(corners, 1, axis=1) - corners
    weight = (ahead**2).sum(-1) * (behind**2).sum(-1)  # (T, 3)
    share = np.cross(ahead, behind) / np.where(weight > 0.0, weight, np.inf)[..., None]
    group = _smooth_corners(mesh, crease)
    summed = np.stack([np.bincount(group, share[..., axis].ravel()) for axis in range(3)], axis=-1)
    length = np.linalg.norm(summed, axis=1, keepdims=True)
    normals = np.divide(summed, length, out=np.zeros_like(summed), where=length > 0.0)
    return normals[group].reshape(-1, 3, 3)


def _smooth_corners(mesh: trimesh.Trimesh, crease: float) -> NDArray[np.int32]:
    """Return a number per corner (3 T), the same for those that share a normal."""
    faces = np.asarray(mesh.faces)
    smooth = mesh.face_adjacency_angles < crease
    pairs = mesh.face_adjacency[smooth]  # two triangles
    edges = mesh.face_adjacency_edges[smooth]  # and the two vertices they share
    first: list[NDArray[np.int64]] = []
    second: list[NDArray[np.int64]] = []
    for end in range(2):
        for side, found in ((0, first), (1, second)):
            corner = (faces[pairs[:, side]] == edges[:, end, None]).argmax(axis=1)
            found.append(3 * pairs[:, side] + corner)
    rows, columns = np.concatenate(first), np.concatenate(second)
    size = faces.size
    links = coo_array((np.ones(len(rows), dtype=bool), (rows, columns)), shape=(size, size))
    labels: NDArray[np.int32] = connected_components(links, directed=False)[1]
    return labels
