# SPDX-License-Identifier: MIT
"""What needs no learning: sum the echoes' energy where they can come from."""

from __future__ import annotations

from collections.abc import Iterable

import numpy as np
import trimesh
from numpy.typing import ArrayLike, NDArray

from sononerf.errors import NumericalError
from sononerf.reconstruction.isosurface import isosurface
from sononerf.reconstruction.solid import (
    outer_surface,
    sample_outer_surface,
    sample_surface,
    signed_distance,
)
from sononerf.reconstruction.volume import Volume, grid_over

# Levels tried by `best_level_surface`, as shares of the voxels that lie above, and what it scores.
LEVEL_SHARES = np.geomspace(0.002, 0.5, 12)
LEVEL_SAMPLES = 4000
LEVEL_DISTANCE = 0.005


def backprojection(
    spectrograms: Iterable[ArrayLike],
    positions: ArrayLike,
    rotations: ArrayLike,
    ranges: ArrayLike,
    lower: ArrayLike,
    upper: ArrayLike,
    spacing: float,
    *,
    emitter_offset: ArrayLike,
    ear_offsets: ArrayLike,
) -> Volume:
    r"""Incoherent delay-and-sum over poses and ears.

    .. math:: I(x) = \frac{1}{P} \sum_p \sum_e \sum_f
              \left|S_{p,e,f}\right|^2 \left(\frac{|x - x_p| + |x - x_{p,e}|}{2}\right)

    Parameters
    ----------
    spectrograms : iterable of (E, R, F) float
        Linear magnitude, one per pose in order; read one at a time.
    positions : (P, 3) float, m
        Heads, world frame.
    rotations : (P, 3, 3) float
        Head to world.
    ranges : (R,) float, m
        Evenly spaced; half the way from emitter over echo to ear.
    lower, upper : (3,) float, m
        The box.
    spacing : float, m
        Voxel size.
    emitter_offset : (3,) float, m
        Emitter in the head frame.
    ear_offsets : (E, 3) float, m
        Ears in the head frame.

    Returns
    -------
    volume : Volume
        Mean energy per voxel; what lies outside the recorded ranges adds nothing.

    Raises
    ------
    ValueError
        If shapes do not fit or the ranges are not evenly spaced.
    NumericalError
        If a spectrogram is not finite.
    ResourceError
        If the grid would not fit in memory.
    """
    heads = np.asarray(positions, dtype=np.float64)
    turns = np.asarray(rotations, dtype=np.float64)
    axis = np.asarray(ranges, dtype=np.float64)
    ears = np.asarray(ear_offsets, dtype=np.float64).reshape(-1, 3)
    if heads.ndim != 2 or heads.shape[1] != 3 or turns.shape != (len(heads), 3, 3):
        raise ValueError(
            f"positions {heads.shape} and rotations {turns.shape}: expected (P, 3) and (P, 3, 3)"
        )
    steps = np.diff(axis)
    if len(axis) < 2 or not (steps > 0).all() or np.ptp(steps) > 1e-3 * steps.mean():
        raise ValueError("ranges: expected two or more, ascending and evenly spaced")
    volume = grid_over(lower, upper, spacing)
    points = volume.points().astype(np.float32)
    emitters = heads + turns @ np.asarray(emitter_offset, dtype=np.float64)
    receivers = heads[:, None] + np.einsum("pij,ej->pei", turns, ears)
    total = np.zeros(len(points))
    count = 0
    for count, spectrogram in enumerate(spectrograms, start=1):
        magnitude = np.asarray(spectrogram)
        if count > len(heads) or magnitude.shape[:2] != (len(ears), len(axis)):
            raise ValueError(
                f"spectrogram {count - 1}: shape {magnitude.shape}, expected "
                f"({len(ears)}, {len(axis)}, F), one for each of {len(heads)} poses"
            )
        energy = np.square(magnitude, dtype=np.float64).sum(axis=2)  # (E, R)
        if not np.isfinite(energy).all():
            raise NumericalError(f"the spectrogram of pose {count - 1} is not finite")
        outward = _distance(points, emitters[count - 1])
        for ear, receiver in enumerate(receivers[count - 1]):
            half = (outward + _distance(points, receiver)) * np.float32(0.5)
            total += _interpolated(energy[ear], half, axis[0], float(steps.mean()))
    if count != len(heads):
        raise ValueError(f"spectrograms: {count}, expected one for each of {len(heads)} poses")
    return volume.with_values((total / max(count, 1)).reshape(volume.shape))


def _distance(points: NDArray[np.float32], place: NDArray[np.float64]) -> NDArray[np.float32]:
    offset = points - place.astype(np.float32)
    distance: NDArray[np.float32] = np.sqrt(np.einsum("ni,ni->n", offset, offset))
    return distance


def _interpolated(
    energy: NDArray[np.float64], ranges: NDArray[np.float32], start: float, step: float
) -> NDArray[np.float32]:
    """Read an evenly spaced profile linearly; zero outside it."""
    # One silent slice at each end stands for everything beyond, and the last index stays inside.
    padded = np.zeros(len(energy) + 3, np.float32)
    padded[1:-2] = energy
    place = np.clip((ranges - np.float32(start)) / np.float32(step) + 1, 0, len(energy) + 1)
    index = place.astype(np.intp)
    fraction = place - index.astype(np.float32)
    low = padded[index]
    value: NDArray[np.float32] = low + fraction * (padded[index + 1] - low)
    return value


def best_level_surface(volume: Volume, truth: trimesh.Trimesh) -> tuple[trimesh.Trimesh, float]:
    """Extract the surface at the level that suits a baseline best, *knowing the truth*.

    A baseline has no rule for its level. Rather than put it at a disadvantage it is given the best
    of twelve levels, judged by the F-score at 5 mm against the true surface. Never use this on what
    is being evaluated.

    Parameters
    ----------
    volume : Volume
        Greater values are inside.
    truth : Trimesh
        The true surface.

    Returns
    -------
    mesh : Trimesh
        The best surface.
    level : float
        Its level.

    Raises
    ------
    NumericalError
        If no level gives a surface.
    """
    target, _ = sample_outer_surface(truth, LEVEL_SAMPLES, seed=0)
    surface = outer_surface(truth)
    best: tuple[float, trimesh.Trimesh, float] | None = None
    for level in np.unique(np.quantile(volume.values, 1 - LEVEL_SHARES)):
        try:
            mesh = isosurface(volume, float(level))
        except NumericalError:
            continue
        points, _ = sample_surface(mesh, LEVEL_SAMPLES, np.random.default_rng(0))
        precision = (np.abs(signed_distance(points, surface)) <= LEVEL_DISTANCE).mean()
        recall = (np.abs(signed_distance(target, mesh)) <= LEVEL_DISTANCE).mean()
        score = float(2 * precision * recall / max(precision + recall, 1e-12))
        if best is None or score > best[0]:
            best = score, mesh, float(level)
    if best is None:
        raise NumericalError("no level gives a surface: the volume's values are all but equal")
    return best[1], best[2]
