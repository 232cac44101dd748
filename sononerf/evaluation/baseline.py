# SPDX-License-Identifier: MIT
"""What needs no learning: sum the echoes' energy where they can come from."""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from typing import Any

import numpy as np
import trimesh
from numpy.typing import ArrayLike, NDArray

from sononerf.errors import NumericalError
from sononerf.evaluation.solid import Nearest, Solid, sample_surface
from sononerf.geometry.poses import Poses
from sononerf.head.head import Head
from sononerf.head.matched_filter import matched_filter
from sononerf.surface.start.isosurface import isosurface
from sononerf.surface.start.volume import Volume, grid_over

# Levels tried by `best_level_surface`, as shares of the voxels that lie above, and what it scores.
LEVEL_SHARES = np.geomspace(0.002, 0.5, 12)
LEVEL_SAMPLES = 4000
LEVEL_DISTANCE = 0.005
# Of the coherent sum: samples per period of the call's highest frequency (straight lines between
# them err by 2 %), and how much of the call's energy lies below that.
SAMPLES_PER_PERIOD = 16
ENERGY = 0.99


def backprojection(
    spectrograms: Iterable[ArrayLike],
    poses: Poses,
    head: Head,
    lower: ArrayLike,
    upper: ArrayLike,
    spacing: float,
) -> Volume:
    r"""Incoherent delay-and-sum over poses and ears.

    .. math:: I(x) = \frac{1}{P} \sum_p \sum_e \sum_f
              \left|S_{p,e,f}\right|^2 \left(\frac{|x - x_p| + |x - x_{p,e}|}{2}\right)

    Args:
        spectrograms (iterable of (E, R, F) float): Linear magnitude, one per pose in order; read
            one at a time.
        poses: P of them.
        head: What heard the spectrograms.
        lower, upper ((3,), m): The box.
        spacing (m): Voxel size.

    Returns:
        volume: Mean energy per voxel; what lies outside the recorded ranges adds nothing.

    Raises:
        ValueError: If there is not one spectrogram of the head's shape for each pose.
        NumericalError: If a spectrogram is not finite.
        ResourceError: If the grid does not fit in memory.
    """
    emitters, receivers = head.places(poses.positions, poses.rotations)
    axis = head.range
    volume = grid_over(lower, upper, spacing)
    points = volume.points().astype(np.float32)
    step = float(np.diff(axis).mean())
    total = np.zeros(len(points))
    profiles = range_profiles(spectrograms, (*receivers.shape[:2], len(axis)))
    for energy, emitter, ears in zip(profiles, emitters, receivers, strict=True):
        outward = _distance(points, emitter)
        for profile, receiver in zip(energy, ears, strict=True):
            half = (outward + _distance(points, receiver)) * np.float32(0.5)
            total += _interpolated(profile, half, axis[0], step)
    return volume.with_values((total / max(len(emitters), 1)).reshape(volume.shape))


def coherent_backprojection(
    waveforms: Iterable[ArrayLike],
    poses: Poses,
    head: Head,
    lower: ArrayLike,
    upper: ArrayLike,
    spacing: float,
) -> Volume:
    r"""Delay-and-sum with phase over poses and ears, for comparison.

    .. math:: I(x) = \left|\frac{1}{P E} \sum_p \sum_e
              y_{p,e}\left(\frac{|x - x_p| + |x - x_{p,e}|}{c}\right)\right|

    with :math:`y` the pulse-compressed recordings,
    :func:`sononerf.head.matched_filter.matched_filter`. It asks for poses that are right to a
    fraction of a wavelength.

    Args:
        waveforms (iterable of (E, S) float): Recordings from the start of the emission on, one per
            pose in order; read one at a time.
        poses, lower, upper: As of :func:`backprojection`.
        head: Whose call was emitted.
        spacing (m): Voxel size; a quarter of the shortest wavelength shows all there is.

    Returns:
        volume: Magnitude of the mean compressed pressure per voxel.

    Raises:
        ValueError: If shapes do not fit.
        NumericalError: If a recording is not finite.
        ResourceError: If the grid would not fit in memory.
    """
    emitted = head.waveform
    finer = _oversampling(emitted)
    step = head.speed_of_sound / (2.0 * head.sampling_rate * finer)
    emitters, receivers = head.places(poses.positions, poses.rotations)
    volume = grid_over(lower, upper, spacing)
    points = volume.points().astype(np.float32)
    total = np.zeros(len(points), dtype=np.complex64)
    count = 0
    for count, recording in enumerate(waveforms, start=1):
        heard = np.asarray(recording, dtype=np.float64)
        if count > len(emitters) or heard.ndim != 2 or len(heard) != receivers.shape[1]:
            raise ValueError(
                f"recording {count - 1}: shape {heard.shape}, expected ({receivers.shape[1]}, S), "
                f"one for each of {len(emitters)} poses"
            )
        if not np.isfinite(heard).all():
            raise NumericalError(f"the recording of pose {count - 1} is not finite")
        outward = _distance(points, emitters[count - 1])
        compressed = matched_filter(heard, emitted, oversampling=finer).astype(np.complex64)
        for echo, receiver in zip(compressed, receivers[count - 1], strict=True):
            half = (outward + _distance(points, receiver)) * np.float32(0.5)
            total += _interpolated(echo, half, 0.0, step)
    if count != len(emitters):
        raise ValueError(f"recordings: {count}, expected one for each of {len(emitters)} poses")
    summed = np.abs(total).astype(np.float64) / max(receivers.shape[0] * receivers.shape[1], 1)
    return volume.with_values(summed.reshape(volume.shape))


def _oversampling(call: NDArray[np.float64]) -> int:
    """Return how much finer a compressed call is sampled, so that straight lines will do."""
    power = np.abs(np.fft.rfft(call, 2 * max(len(call), 8))) ** 2
    below = np.cumsum(power) / max(power.sum(), 1e-300)
    highest = (int(np.searchsorted(below, ENERGY)) + 1) / (2 * len(power))  # per sample
    return max(1, int(np.ceil(SAMPLES_PER_PERIOD * highest)))


def range_profiles(
    spectrograms: Iterable[ArrayLike], shape: tuple[int, int, int]
) -> Iterator[NDArray[np.float64]]:
    """Yield each pose's energy, summed over frequency, (E, R).

    Args:
        spectrograms (iterable of (E, R, F) float): Linear magnitude, one per pose; read one at a
            time.
        shape (P, E, R): What is expected.

    Raises:
        ValueError: If there are more, fewer or other ones.
        NumericalError: If one is not finite.
    """
    poses, ears, slices = shape
    count = 0
    for count, spectrogram in enumerate(spectrograms, start=1):
        magnitude = np.asarray(spectrogram)
        if count > poses or magnitude.shape[:2] != (ears, slices):
            raise ValueError(
                f"spectrogram {count - 1}: shape {magnitude.shape}, expected "
                f"({ears}, {slices}, F), one for each of {poses} poses"
            )
        energy = np.square(magnitude, dtype=np.float64).sum(axis=2)
        if not np.isfinite(energy).all():
            raise NumericalError(f"the spectrogram of pose {count - 1} is not finite")
        yield energy
    if count != poses:
        raise ValueError(f"spectrograms: {count}, expected one for each of {poses} poses")


def _distance(points: NDArray[np.float32], place: NDArray[np.float64]) -> NDArray[np.float32]:
    offset = points - place.astype(np.float32)
    distance: NDArray[np.float32] = np.sqrt(np.einsum("ni,ni->n", offset, offset))
    return distance


def _interpolated(
    profile: NDArray[Any], ranges: NDArray[np.float32], start: float, step: float
) -> NDArray[Any]:
    """Read an evenly spaced profile linearly; zero outside it. In single precision."""
    # One silent slice at each end stands for everything beyond, and the last index stays inside.
    kind = np.complex64 if np.iscomplexobj(profile) else np.float32
    padded = np.zeros(len(profile) + 3, kind)
    padded[1:-2] = profile
    place = np.clip((ranges - np.float32(start)) / np.float32(step) + 1, 0, len(profile) + 1)
    index = place.astype(np.intp)
    fraction = place - index.astype(np.float32)
    low = padded[index]
    value: NDArray[Any] = low + fraction * (padded[index + 1] - low)
    return value


def best_level_surface(
    volume: Volume, truth: trimesh.Trimesh | Solid
) -> tuple[trimesh.Trimesh, float]:
    """Extract the surface at the level that suits a baseline best, *knowing the truth*.

    A baseline has no rule for its level. Rather than put it at a disadvantage it is given the best
    of twelve levels, judged by the F-score at 5 mm against the true surface. Never use this on what
    is being evaluated.

    Args:
        volume: Greater values are inside.
        truth: The true surface.

    Returns:
        mesh: The best surface.
        level: Its level.

    Raises:
        NumericalError: If no level gives a surface.
    """
    true = truth if isinstance(truth, Solid) else Solid(truth)
    target, _ = true.samples(LEVEL_SAMPLES, 0)
    best: tuple[float, trimesh.Trimesh, float] | None = None
    for level in np.unique(np.quantile(volume.values, 1 - LEVEL_SHARES)):
        try:
            mesh = isosurface(volume, float(level))
        except NumericalError:
            continue
        points, _ = sample_surface(mesh, LEVEL_SAMPLES, 0)
        precision = true.nearest.near(points, LEVEL_DISTANCE).mean()
        recall = Nearest(mesh).near(target, LEVEL_DISTANCE).mean()
        score = float(2 * precision * recall / max(precision + recall, 1e-12))
        if best is None or score > best[0]:
            best = score, mesh, float(level)
    if best is None:
        raise NumericalError("no level gives a surface: the volume's values are all but equal")
    return best[1], best[2]
