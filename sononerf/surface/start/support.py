# SPDX-License-Identifier: MIT
"""How many poses heard each place of a surface."""

from __future__ import annotations

import numpy as np
import trimesh
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from sononerf.surface.start.evidence import Evidence
from sononerf.surface.start.reliability import ALIGNED, REACH

_ALIKE = 0.5  # cosine of the greatest angle between the normals of a vertex and of a point
_PAIRS = 2_000_000  # vertices times points at a time, a bound of memory


def poses_that_heard(
    mesh: trimesh.Trimesh, evidence: Evidence, resolution: float
) -> NDArray[np.int32]:
    """Count the poses that heard the surface around each vertex.

    A pose counts where a point of its evidence lies within two range resolutions of the vertex,
    looks the same way within 60 degrees, and lies on one smooth surface with it.

    Parameters
    ----------
    mesh : Trimesh
        Normals outward, m.
    evidence : Evidence
        Of all poses.
    resolution : float, m
        Range resolution.

    Returns
    -------
    poses : (V,) int32
    """
    counts = np.zeros(len(mesh.vertices), np.int32)
    if not len(evidence.points):
        return counts
    vertices, normals = np.asarray(mesh.vertices), np.asarray(mesh.vertex_normals)
    tree = cKDTree(evidence.points)
    chunk = max(1, _PAIRS // len(evidence.points))
    # Neighbours together, so that few points are near each chunk.
    order = cKDTree(vertices).indices
    poses = evidence.pose.max() + 1
    for start in range(0, len(order), chunk):
        some = order[start : start + chunk]
        pairs = cKDTree(vertices[some]).sparse_distance_matrix(
            tree, REACH * resolution, output_type="ndarray"
        )
        i, j = pairs["i"], pairs["j"]
        ours, theirs = normals[some[i]], evidence.normals[j]
        alike = np.einsum("nd,nd->n", ours, theirs) > _ALIKE
        between = evidence.points[j] - vertices[some[i]]
        off = np.abs(np.einsum("nd,nd->n", between, ours + theirs))
        agrees = alike & (off < 2 * ALIGNED * resolution)
        pose = evidence.pose[j[agrees]].astype(np.int64)
        both = np.unique(i[agrees].astype(np.int64) * poses + pose)
        counts[some] = np.bincount(both // poses, minlength=len(some))
    return counts
