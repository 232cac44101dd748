# SPDX-License-Identifier: MIT
"""Baselines without a learned field: backprojection, and a voxel fit."""

from __future__ import annotations

import math
from collections.abc import Iterable, Iterator
from typing import Any, TypeAlias

import numpy as np
import trimesh
from numpy.typing import ArrayLike, NDArray

from sononerf.echoes.memory_ensemble import Ensemble
from sononerf.errors import NumericalError
from sononerf.evaluation.metrics import Nearest, Solid, sample_surface
from sononerf.geometry.lattice import Volume, grid_over, isosurface
from sononerf.geometry.poses import Poses
from sononerf.head.head import Head
from sononerf.numerics import Floats, Ints, Singles, compiled

# Levels tried by `best_level_surface`, as fractions of the voxels above them, and the score.
LEVEL_SHARES = np.geomspace(0.002, 0.5, 12)
LEVEL_SAMPLES = 4000
LEVEL_DISTANCE = 0.005


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

    In: spectrograms (iterable of (E, R, F) float), lower, upper ((3,), m), spacing (m).
    """
    emitters, receivers = head.places(poses.positions, poses.rotations)
    axis = head.range
    volume = grid_over(lower, upper, spacing)
    axes = volume.axes()
    step = float(np.diff(axis).mean())
    total = np.zeros(volume.values.shape)
    profiles = range_profiles(spectrograms, (*receivers.shape[:2], len(axis)))
    for energy, emitter, ears in zip(profiles, emitters, receivers, strict=True):
        for profile, receiver in zip(energy, ears, strict=True):
            squares = _squares(axes, emitter, receiver)
            _spread(total, _padded(profile), *squares, float(axis[0]), step)
    return volume.with_values(total / max(len(emitters), 1))


def range_profiles(
    spectrograms: Iterable[ArrayLike], shape: tuple[int, int, int]
) -> Iterator[Floats]:
    """Yield each pose's energy, summed over frequency, (E, R).

    In: spectrograms (iterable of (E, R, F) float), shape (P, E, R).
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


Six: TypeAlias = tuple[Singles, Singles, Singles, Singles, Singles, Singles]


def _squares(axes: tuple[Floats, Floats, Floats], out: Floats, back: Floats) -> Six:
    """Return the squared distances, m², of grid lines from two places: three axes for each."""
    x, y, z, u, v, w = (
        np.square(along - at).astype(np.float32)
        for place in (out, back)
        for along, at in zip(axes, place, strict=True)
    )
    return x, y, z, u, v, w


def _padded(profile: NDArray[Any]) -> Singles:
    """Put one silent slice at each end, and one more, so that the last index stays inside."""
    padded = np.zeros(len(profile) + 3, np.float32)
    padded[1:-2] = profile
    return padded


@compiled
def _spread(
    total: NDArray[Any],
    profile: NDArray[Any],
    x_out: Singles,
    y_out: Singles,
    z_out: Singles,
    x_back: Singles,
    y_back: Singles,
    z_back: Singles,
    start: float,
    step: float,
) -> None:
    """Add a profile to each voxel of a grid, read at half the way out and back, in place.

    In: total (X, Y, Z), profile (R + 3,), zero outside, x_out, y_out, z_out, x_back, y_back, z_back
    (m²), start,
    step (m).
    """
    last, scale = len(profile) - 2.0, 0.5 / step
    for i in range(total.shape[0]):
        for j in range(total.shape[1]):
            out, back = x_out[i] + y_out[j], x_back[i] + y_back[j]
            for k in range(total.shape[2]):
                path = math.sqrt(out + z_out[k]) + math.sqrt(back + z_back[k])
                place = min(max(scale * path - start / step + 1.0, 0.0), last)
                index = int(place)
                low = profile[index]
                total[i, j, k] += low + (place - index) * (profile[index + 1] - low)


def best_level_surface(
    volume: Volume, truth: trimesh.Trimesh | Solid
) -> tuple[trimesh.Trimesh, float]:
    """Extract the surface at the level that suits a baseline best, *knowing the truth*.

    A baseline has no rule for its level. To its advantage it gets the best of twelve levels, by the
    F-score at 5 mm against the true surface. Never use this function on the result under
    evaluation.
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


# How often all poses are gone through, and in how many portions each time.
PASSES, PORTIONS = 5, 10
# A model below this part of the mean energy counts as no louder; else noise is divided by nothing.
FLOOR = 1e-9
# Steps at which the depth of a voxel is laid over the window.
DEPTH_STEPS = 9


def voxel_fit(
    spectrograms: Iterable[ArrayLike],
    poses: Poses,
    head: Head,
    lower: ArrayLike,
    upper: ArrayLike,
    spacing: float,
    *,
    passes: int = PASSES,
) -> Volume:
    r"""Fit a power to each voxel, the same towards all sides and for all frequencies.

    .. math:: \sum_f |S_{p,e,f}(r)|^2 \approx \sum_i W(r - r_i)\, \frac{w_i}{r_i^4},
              \qquad r_i = \frac{|x_i - x_p| + |x_i - x_{p,e}|}{2}

    Known are the true places of emitter and ears, spreading, and the analysis window
    :math:`W`, laid over the depth of a voxel; beam, ears and air are not. The powers follow from
    multiplicative updates [1]_ [2]_, which keep them zero or more, a tenth of the poses at
    a time [3]_: five passes of ten portions come about as far as fifty passes over all at once.

    Each portion holds every tenth pose, so that it hears from everywhere. Voxels and bins of range
    are paired anew each time, so memory does not grow with poses times voxels: 400 poses and
    180,000 voxels take 7 s on one core. Surfaces come out too far out, as in all that knows no
    directions: a voxel just outside a mirror-like body lies in the shells of more poses than one
    on it does.

    References:
        .. [1] L. B. Lucy, "An iterative technique for the rectification of observed distributions",
           1974, equation (15).
        .. [2] L. A. Shepp and Y. Vardi, "Maximum likelihood reconstruction for emission
           tomography", 1982.
        .. [3] H. M. Hudson and R. S. Larkin, "Accelerated image reconstruction using ordered
           subsets of projection data", 1994.
    """
    emitters, receivers = head.places(poses.positions, poses.rotations)
    axis = head.range
    volume = grid_over(lower, upper, spacing)
    step = float(np.diff(axis).mean())
    # Of a sweep each row has a window of its own; where rows are added up, their mean.
    window = np.square(head.window).mean(axis=0)
    kernel = _kernel(window, head.speed_of_sound / head.sampling_rate / 2, step, spacing)
    energies = np.array(list(range_profiles(spectrograms, (*receivers.shape[:2], len(axis)))))
    half_width = len(kernel) // 2
    bins = len(axis) + 2 * half_width
    first = axis[0] - half_width * step
    with np.errstate(divide="ignore"):
        spread = np.maximum(first + step * np.arange(bins), 0.0) ** -4.0
    spread[~np.isfinite(spread)] = 0.0
    audible = _heard_back(np.ones(len(axis)), kernel, spread)
    floor = FLOOR * max(float(energies.mean()), np.finfo(float).tiny) if energies.size else 1.0
    axes = volume.axes()
    power = np.ones(volume.shape)
    index = np.zeros(volume.shape, np.int32)
    portions = max(1, min(PORTIONS, len(emitters)))
    for _ in range(passes):
        for portion in range(portions):
            gained, sensed = np.zeros((2, *power.shape), np.float32)
            for pose in range(portion, len(emitters), portions):
                for energy, receiver in zip(energies[pose], receivers[pose], strict=True):
                    squares = _squares(axes, emitters[pose], receiver)
                    fine = _sorted(index, power, *squares, float(first), step, bins) * spread
                    model = np.convolve(fine, kernel, mode="valid")
                    ratio = energy / np.maximum(model, floor)
                    _gather(gained, sensed, index, _heard_back(ratio, kernel, spread), audible)
            power *= np.divide(gained, sensed, out=np.zeros_like(gained), where=sensed > 0)
    return volume.with_values(power)


def _kernel(values: Floats, window_step: float, step: float, depth: float) -> Floats:
    """Return the response of the slices around a voxel: the window, over the voxel's depth."""
    half = (len(values) - 1) / 2
    # So far that even the nearest part of a voxel's depth lies beyond the window: zero at the ends.
    half_width = int(np.ceil((half * window_step + depth / 2) / step))
    slices = step * np.arange(-half_width, half_width + 1)
    shifts = depth * ((np.arange(DEPTH_STEPS) + 0.5) / DEPTH_STEPS - 0.5)
    place = (slices[:, None] + shifts) / window_step + half
    return np.interp(place, np.arange(len(values)), values, left=0.0, right=0.0).mean(axis=1)


def _heard_back(profile: Floats, kernel: Floats, spread: Floats) -> Singles:
    """Carry a profile from the slices back to the bins of range: the adjoint of hearing."""
    back = np.convolve(profile, kernel[::-1], mode="full") * spread
    return back.astype(np.float32)


@compiled
def _sorted(
    index: NDArray[np.int32],
    power: Floats,
    x_out: Singles,
    y_out: Singles,
    z_out: Singles,
    x_back: Singles,
    y_back: Singles,
    z_back: Singles,
    first: float,
    step: float,
    bins: int,
) -> Floats:
    """Return the power in each bin of range, and write into ``index`` which bin a voxel is in.

    The ends of the window are zero: the outermost bins, and all that lies beyond, are silent.

    In: index (X, Y, Z), overwritten, power (X, Y, Z), x_out, y_out, z_out, x_back, y_back, z_back
    (m²), first,
    step (m).
    """
    total = np.zeros(bins)
    for i in range(power.shape[0]):
        for j in range(power.shape[1]):
            out, back = x_out[i] + y_out[j], x_back[i] + y_back[j]
            for k in range(power.shape[2]):
                path = math.sqrt(out + z_out[k]) + math.sqrt(back + z_back[k])
                place = min(max(int(0.5 / step * path - first / step + 0.5), 0), bins - 1)
                index[i, j, k] = place
                total[place] += power[i, j, k]
    return total


@compiled
def _gather(
    gained: Singles, sensed: Singles, index: NDArray[np.int32], heard: Singles, audible: Singles
) -> None:
    """Add the heard power and the audibility of its bin to each voxel (X, Y, Z), in place."""
    for i in range(index.shape[0]):
        for j in range(index.shape[1]):
            for k in range(index.shape[2]):
                gained[i, j, k] += heard[index[i, j, k]]
                sensed[i, j, k] += audible[index[i, j, k]]


BASELINES = {"backprojection": backprojection, "voxels": voxel_fit}
"""Baselines of a surface, by their names in ``metrics.json``."""


def volume_of(store: Ensemble, name: str, numbers: Ints, *given: Any) -> Volume:
    """Return the volume of a baseline; a function that other processes can import.

    In: numbers (P,).
    """
    heard = (store.read_pose(int(number)) for number in numbers)
    return BASELINES[name](heard, *given)
