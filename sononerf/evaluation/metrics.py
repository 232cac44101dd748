# SPDX-License-Identifier: MIT
"""Metrics of a reconstructed surface against the true one."""

from __future__ import annotations

from typing import Any

import numpy as np
import trimesh
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from sononerf.evaluation.prediction import prediction_metrics
from sononerf.evaluation.solid import Nearest, Solid, sample_surface
from sononerf.head.decibels import mae_db
from sononerf.numerics import Floats

__all__ = ["geometry_metrics", "mae_db", "prediction_metrics", "target_metrics"]


def geometry_metrics(
    reconstructed: trimesh.Trimesh,
    truth: trimesh.Trimesh | Solid,
    *,
    samples: int = 100_000,
    seed: int = 0,
    thresholds: tuple[float, ...] = (0.001, 0.002, 0.005),
) -> dict[str, Any]:
    """Compare a reconstructed surface with the true one.

    The true surface is the outer surface of the solid union of the true bodies. Of the
    reconstruction all surface counts, a wall inside it too. Distances are exact, from area-uniform
    samples of the one surface to the triangles of the other.

    In: thresholds (tuple of float, m).
    """
    true = truth if isinstance(truth, Solid) else Solid(truth)
    solid = Solid(reconstructed, fill_cavities=False)
    true_points, true_normals = true.samples(samples, seed)
    points, face = sample_surface(reconstructed, samples, seed + 1)
    normals = np.asarray(reconstructed.face_normals)[face]
    to_truth = true.nearest.distance(points)
    to_found = Nearest(reconstructed).distance(true_points)
    return {
        "chamfer_m": float(to_truth.mean() + to_found.mean()) / 2,
        "fscore": {f"{limit:g}": _fscore(to_truth, to_found, limit) for limit in thresholds},
        "thickness_bias_m": _thickness_bias(true, points, to_truth),
        **_volume_metrics(solid, true),
        "normal_consistency": _normal_consistency(points, normals, true_points, true_normals),
        "components": solid.components,
        "components_true": true.components,
    }


def target_metrics(
    reconstructed: trimesh.Trimesh,
    target: trimesh.Trimesh,
    background: trimesh.Trimesh,
    *,
    samples: int = 100_000,
    seed: int = 0,
    thresholds: tuple[float, ...] = (0.001, 0.002, 0.005),
) -> dict[str, Any]:
    """Compare a reconstruction of a target amid surroundings with the target alone.

    Parts of the reconstruction count if they are nearer to the true target than to the true
    surroundings; else as :func:`geometry_metrics`.

    In: thresholds (tuple of float, m).
    """
    true = Solid(target)
    points, face = sample_surface(reconstructed, samples, seed + 1)
    around = Nearest(background)
    to_truth = true.nearest.distance(points)
    counts = to_truth <= around.distance(points)
    metrics: dict[str, Any] = {"share": float(counts.mean())}
    if not counts.any():
        return {**metrics, "chamfer_m": None, "fscore": {f"{limit:g}": 0.0 for limit in thresholds}}
    to_truth = to_truth[counts]
    # The border of the counted part is as coarse as the triangles.
    middles = np.asarray(reconstructed.triangles_center)
    kept = true.nearest.distance(middles) <= around.distance(middles)
    kept[face[counts]] = True
    part = trimesh.Trimesh(reconstructed.vertices, reconstructed.faces[kept], process=False)
    to_found = Nearest(part).distance(true.samples(samples, seed)[0])
    return {
        **metrics,
        "chamfer_m": float(to_truth.mean() + to_found.mean()) / 2,
        "fscore": {f"{limit:g}": _fscore(to_truth, to_found, limit) for limit in thresholds},
    }


def _fscore(to_truth: Floats, to_found: Floats, limit: float) -> float:
    precision, recall = float((to_truth <= limit).mean()), float((to_found <= limit).mean())
    return 2 * precision * recall / (precision + recall) if precision + recall else 0.0


def _thickness_bias(true: Solid, points: Floats, to_truth: Floats) -> float | None:
    if not true.closed:
        return None
    return float(np.where(true.contains(points), -to_truth, to_truth).mean())


def _volume_metrics(reconstructed: Solid, true: Solid) -> dict[str, float | None]:
    if not (reconstructed.closed and true.closed):
        return {"volume_ratio": None, "iou": None}
    shared = reconstructed.shared_volume(true)
    return {
        "volume_ratio": reconstructed.volume / true.volume,
        "iou": shared / (reconstructed.volume + true.volume - shared),
    }


def _normal_consistency(
    points: Floats, normals: Floats, true_points: Floats, true_normals: Floats
) -> float:
    there, back = _nearest_of(true_points, points), _nearest_of(points, true_points)
    forward = np.abs((normals * true_normals[there]).sum(axis=1)).mean()
    backward = np.abs((true_normals * normals[back]).sum(axis=1)).mean()
    return float(forward + backward) / 2


def _nearest_of(points: Floats, places: Floats) -> NDArray[np.intp]:
    """Return which of the points is nearest to each place, (N,)."""
    # Neighbours follow one another, so that their part of the tree is still in the cache.
    cells = ((places - places.min(axis=0)) / max(float(np.ptp(places)), 1e-12) * 64).astype(np.intp)
    order = np.lexsort(cells.T)
    found = np.zeros(len(places), np.intp)
    found[order] = cKDTree(points).query(places[order])[1]
    return found
