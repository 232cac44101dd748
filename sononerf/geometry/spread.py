# SPDX-License-Identifier: MIT
"""Points spread evenly over a surface."""

from __future__ import annotations

import numpy as np
import trimesh
from numpy.typing import NDArray

from sononerf.geometry.normals import corner_normals

POOL = 10  # points on the surface from which one is chosen
PLASTIC = 1.324717957244746  # root of x^3 = x + 1; its powers spread points over a square evenly


def spread_points(
    mesh: trimesh.Trimesh, count: int
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Choose points of a surface, each as far as possible from those before it [1]_.

    So any first ones of them are spread evenly over the surface, whatever its triangles.

    Parameters
    ----------
    mesh : trimesh.Trimesh
        The surface.
    count : int
        How many points, N.

    Returns
    -------
    points : (N, 3) float64, m
        On the triangles.
    normals : (N, 3) float64
        Of the smooth surface, outward unit vectors.

    References
    ----------
    .. [1] T. F. Gonzalez, "Clustering to minimize the maximum intercluster distance",
       Theoretical Computer Science 38, 1985.
    """
    # A pool of points, as many on each part of the area, uniform over their triangles: Osada et
    # al., "Shape distributions", ACM TOG 21(4), 2002.
    pool = POOL * count
    end = np.cumsum(np.asarray(mesh.area_faces, dtype=np.float64))
    place = (np.arange(pool) + 0.5) / pool * end[-1]
    triangle = np.searchsorted(end, place).clip(max=len(end) - 1)
    first = np.mod(np.arange(pool) / PLASTIC, 1.0)
    second = np.mod(np.arange(pool) / PLASTIC**2, 1.0)
    root = np.sqrt(first)
    weights = np.stack([1.0 - root, root * (1.0 - second), root * second], axis=1)
    corners = np.asarray(mesh.triangles, dtype=np.float64)
    points = np.einsum("nc,ncd->nd", weights, corners[triangle])
    normals = np.einsum("nc,ncd->nd", weights, corner_normals(mesh)[triangle])
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    # Single precision suffices to tell which is farthest.
    single = (points - points.mean(axis=0)).astype(np.float32).T.copy()
    gap = np.full(pool, np.inf, dtype=np.float32)
    chosen = np.zeros(count, dtype=np.int64)
    for index in range(1, count):
        off = single - single[:, chosen[index - 1], None]
        np.minimum(gap, (off * off).sum(axis=0), out=gap)
        chosen[index] = gap.argmax()
    return points[chosen], normals[chosen]
