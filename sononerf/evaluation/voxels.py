# SPDX-License-Identifier: MIT
"""A plain voxel fit: what a differentiable renderer gives without a neural field or directions."""

from __future__ import annotations

from collections.abc import Iterable

import numpy as np
from numpy.typing import ArrayLike, NDArray

from sononerf.evaluation.baseline import range_profiles
from sononerf.geometry.poses import Poses
from sononerf.head.head import Head
from sononerf.surface.start.volume import Volume, grid_over

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

    Args:
        spectrograms, poses, head, lower, upper, spacing: As of
            :func:`sononerf.evaluation.baseline.backprojection`; the emitter is near the ears
            against the ranges.
        passes: How often all poses are gone through.

    Returns:
        volume: Power per voxel, as heard at one metre; zero where no recorded range reaches.

    Raises:
        ValueError: If there is not one spectrogram of the head's shape for each pose, or there is
            no pass.
        NumericalError: If a spectrogram is not finite.
        ResourceError: If the grid would not fit in memory.

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
    if passes < 1:
        raise ValueError(f"passes: {passes}, expected 1 or more")
    volume = grid_over(lower, upper, spacing)
    step = float(np.diff(axis).mean())
    # Of a sweep each row has a window of its own; where rows are added up, their mean.
    window = np.square(head.window).mean(axis=0)
    kernel = _kernel(window, head.speed_of_sound / head.sampling_rate / 2, step, spacing)
    energies = np.array(list(range_profiles(spectrograms, (*receivers.shape[:2], len(axis)))))
    reach = len(kernel) // 2
    bins = len(axis) + 2 * reach
    first = axis[0] - reach * step
    with np.errstate(divide="ignore"):
        spread = np.maximum(first + step * np.arange(bins), 0.0) ** -4.0
    spread[~np.isfinite(spread)] = 0.0
    audible = _heard_back(np.ones(len(axis)), kernel, spread)
    floor = FLOOR * max(float(energies.mean()), np.finfo(float).tiny) if energies.size else 1.0
    axes = [along.astype(np.float32) for along in volume.axes()]
    power = np.ones(volume.values.size)
    portions = max(1, min(PORTIONS, len(emitters)))
    for _ in range(passes):
        for portion in range(portions):
            gained, sensed = np.zeros((2, len(power)), np.float32)
            for pose in range(portion, len(emitters), portions):
                outward = _distance(axes, emitters[pose])
                for energy, receiver in zip(energies[pose], receivers[pose], strict=True):
                    half = (outward + _distance(axes, receiver)) * np.float32(0.5 / step)
                    index = (half - np.float32(first / step - 0.5)).astype(np.intp).ravel()
                    # The kernel's ends are zero: the outermost bins, and all beyond, are silent.
                    np.clip(index, 0, bins - 1, out=index)
                    fine = np.bincount(index, power, minlength=bins) * spread
                    model = np.convolve(fine, kernel, mode="valid")
                    ratio = energy / np.maximum(model, floor)
                    gained += _heard_back(ratio, kernel, spread)[index]
                    sensed += audible[index]
            power *= np.divide(gained, sensed, out=np.zeros_like(gained), where=sensed > 0)
    return volume.with_values(power.reshape(volume.shape))


def _kernel(
    values: NDArray[np.float64], window_step: float, step: float, depth: float
) -> NDArray[np.float64]:
    """Return what a voxel leaves in the slices around it: the window, over the voxel's depth."""
    half = (len(values) - 1) / 2
    # So far that even the nearest part of a voxel's depth lies beyond the window: zero at the ends.
    reach = int(np.ceil((half * window_step + depth / 2) / step))
    slices = step * np.arange(-reach, reach + 1)
    shifts = depth * ((np.arange(DEPTH_STEPS) + 0.5) / DEPTH_STEPS - 0.5)
    place = (slices[:, None] + shifts) / window_step + half
    kernel: NDArray[np.float64] = np.interp(
        place, np.arange(len(values)), values, left=0.0, right=0.0
    ).mean(axis=1)
    return kernel


def _heard_back(
    profile: NDArray[np.float64], kernel: NDArray[np.float64], spread: NDArray[np.float64]
) -> NDArray[np.float32]:
    """Carry a profile from the slices back to the bins of range: the adjoint of hearing."""
    back = np.convolve(profile, kernel[::-1], mode="full") * spread
    result: NDArray[np.float32] = back.astype(np.float32)
    return result


def _distance(axes: list[NDArray[np.float32]], place: NDArray[np.float64]) -> NDArray[np.float32]:
    """Return the distance of every voxel from a place, (X, Y, Z) m."""
    x, y, z = (np.square(a - np.float32(b)) for a, b in zip(axes, place, strict=True))
    distance: NDArray[np.float32] = np.sqrt(x[:, None, None] + y[:, None] + z)
    return distance
