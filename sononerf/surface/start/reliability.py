# SPDX-License-Identifier: MIT
"""How far oriented evidence is to be believed, judged by other poses and by the onsets.

Sound that a pose hears from a surface is heard by other poses from the same smooth surface, and the
first sound of a pose comes from what is nearest to it. Later bounces, and what interference makes,
are heard elsewhere from every pose.
"""

from __future__ import annotations

import numpy as np
import trimesh
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from sononerf.echoes.free_space import EchoHull
from sononerf.surface.start.evidence import COMPRESSION, Evidence

Array = NDArray[np.float64]
REACH = 2.0
"""Range resolutions around a point within which others are asked."""
ALIGNED = 0.3
"""Range resolutions that two points may lie off one smooth surface; how far the onset of a pose
may lie from its evidence, as a standard deviation."""
FEW = 0.3
"""Power of agreeing points, over what is usual, that is little."""
AT_ONSET = 0.7
"""Reliability of evidence at its pose's own onset."""
_WITNESSES = 4000  # points that are asked at most, a bound of time
_CHUNK = 4000  # points at a time, a bound of memory


def reliability(evidence: Evidence, hull: EchoHull, resolution: float) -> Array:
    """Return how far each point is believed, (G,) from 0 to 1.

    Args:
        evidence: Of all poses.
        hull: The onsets of the same poses.
        resolution (m): Range resolution.
    """
    if not len(evidence.points):
        return np.zeros(0)
    by_others = _agreement(evidence, resolution)
    own = np.concatenate(
        [
            hull.behind(evidence.points[i : i + _CHUNK])[
                np.arange(len(evidence.points[i : i + _CHUNK])), evidence.pose[i : i + _CHUNK]
            ].min(axis=1)
            for i in range(0, len(evidence.points), _CHUNK)
        ]
    )
    at_onset = AT_ONSET * np.exp(-0.5 * (own / (ALIGNED * resolution)) ** 2)
    return np.maximum(by_others, at_onset)


def _agreement(evidence: Evidence, resolution: float) -> Array:
    """Return the fraction of the power around that lies on one smooth surface, if it is enough."""
    points, normals = evidence.points, evidence.normals
    count = len(points)
    # Evenly over all poses: points come pose by pose.
    asked = np.unique(np.linspace(0, count - 1, min(count, _WITNESSES)).astype(np.intp))
    pairs = cKDTree(points).sparse_distance_matrix(
        cKDTree(points[asked]), REACH * resolution, output_type="ndarray"
    )
    i, j = pairs["i"], asked[pairs["j"]]
    other = evidence.pose[i] != evidence.pose[j]
    i, j = i[other], j[other]
    # Between two points of one sphere the chord is at right angles to the sum of their normals.
    chord = np.einsum("nd,nd->n", points[j] - points[i], normals[i] + normals[j])
    alike = np.einsum("nd,nd->n", normals[i], normals[j]) > 0.5
    agrees = alike & (np.abs(chord) < 2 * ALIGNED * resolution)
    power = evidence.weight ** (1 / COMPRESSION)
    support = np.bincount(i, power[j] * agrees, count)
    around = np.bincount(i, power[j], count) + power
    usual = float(np.average(support, weights=power))
    if not usual > 0:
        return np.zeros(count)
    found: Array = support / around * support / (support + FEW * usual)
    return found


_ALIKE = 0.5  # cosine of the greatest angle between the normals of a vertex and of a point
_PAIRS = 2_000_000  # vertices times points at a time, a bound of memory


def poses_that_heard(
    mesh: trimesh.Trimesh, evidence: Evidence, resolution: float
) -> NDArray[np.int32]:
    """Count the poses that heard the surface around each vertex.

    A pose counts where a point of its evidence lies within two range resolutions of the vertex,
    looks the same way within 60 degrees, and lies on one smooth surface with it.

    Args:
        mesh: Normals outward, m.
        evidence: Of all poses.
        resolution (m): Range resolution.

    Returns:
        poses: (V,) int32.
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
