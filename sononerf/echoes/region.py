# SPDX-License-Identifier: MIT
"""Region: the places that the echoes leave, and the box around those that explain the echoes."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from scipy import ndimage
from scipy.spatial.distance import cdist

from sononerf.echoes.detection import FALSE_ALARMS, Onsets, threshold_levels
from sononerf.echoes.free_space import ACCURACY, EchoHull
from sononerf.errors import NumericalError
from sononerf.head.ears import Ears
from sononerf.numerics import Bools, Floats, Ints

WITNESS_GAIN = 0.1
"""A pose is a witness of the places towards which its gain is at least this fraction of the best,
no unit: 20 dB, beyond which an echo is easily below the threshold."""
AGREEMENT = 0.6
"""Least power from the range of a place, over that of the best place, at which the place is taken,
no unit. It is above 0.5, because two places that share an echo reach 0.5 by chance."""
UNEXPLAINED = 0.02
"""Fraction of the power that may stay without a place, no unit. Bounces among the parts of a body
arrive late and have no place of their own; they hold about as much."""
NOTHING = (
    "no pose received an echo that another one confirms; check scene, poses and range limits, or "
    "set region.lower and region.upper"
)
NOISE = (
    "no pose received an echo: an onset at {count} of {of} ears is no more than noise alone gives; "
    "call louder or from nearer, or check scene, poses, range limits and noise"
)

# Sizes of the search: poses that give power, passes from coarse to fine, cells along the
# longest side in each of them, passes over the power, and places that are processed at once.
POSES, LOOKS, COARSE, ROUNDS, CHUNK = 200, 4, 28, 4, 2048
MIN_POSES = 2  # poses: an echo of one pose alone may come from any place of an ellipsoid


class EchoRegion:
    """Evidence of the poses about places. In: rotations (P, 3, 3), resolution, tail (m)."""

    def __init__(
        self,
        heard: Onsets,
        hull: EchoHull,
        ears: Ears,
        rotations: Floats,
        resolution: float,
        tail: float = 0.0,
    ) -> None:
        if not np.isfinite(hull.inlier_onsets).any():
            raise NumericalError(NOTHING)
        if heard.chance(resolution) > FALSE_ALARMS:
            count, of = int(np.isfinite(heard.first).sum()), heard.first.size
            raise NumericalError(NOISE.format(count=count, of=of))
        self.hull, self.resolution, self.tail, self.range = hull, resolution, tail, heard.range
        self.step = float(heard.range[1] - heard.range[0])
        count = len(heard.poses)
        sampled = np.linspace(0, count - 1, min(POSES, count)).astype(int)
        self.heard = heard.heard[sampled].any(axis=1)  # (P, R)
        total = heard.power[sampled].sum(axis=1) * self.heard
        self.power = total / total.sum(axis=1, keepdims=True).clip(1e-300)
        self.first = hull.inlier_onsets[sampled].max(axis=1)
        self.sources, self.rotations = hull.sources[sampled], rotations[sampled]
        gain = (ears.beam[None] * ears.ears).max(axis=(0, 1))  # (L, A)
        self.witness_gain = gain >= WITNESS_GAIN * gain.max()

    def possible(self, points: Floats, tolerance: float) -> Bools:
        """Return the places that no pose rules out and that some poses heard, (N,).

        In: points ((N, 3), m), tolerance (m).
        """
        return self._inside(points, tolerance / 4) & self._energy(points, tolerance)[1]

    def _inside(self, points: Floats, tolerance: float) -> Bools:
        clearance = self.hull.clearance(points)[0]
        return np.asarray(clearance >= -(tolerance + ACCURACY * self.resolution))

    def _energy(
        self, points: Floats, tolerance: float, power: Floats | None = None
    ) -> tuple[Floats, Bools]:
        """Return the mean power from each place's range, and where enough poses hear any, (N,)."""
        size = 2 * int(np.ceil(tolerance / self.step)) + 1
        heard = ndimage.maximum_filter1d(self.heard, size, axis=1, mode="constant")
        wanted = self.power if power is None else power
        loud = ndimage.maximum_filter1d(wanted, size, axis=1, mode="constant")
        pose = np.arange(len(self.sources))[:, None]
        energy, sounding = [], []
        for start in range(0, len(points), CHUNK):
            distance, row, within = self._rows(points[start : start + CHUNK])
            witness = self._witnesses(points[start : start + CHUNK], distance)
            meets = witness & within
            sounding.append((meets & heard[pose, row]).sum(axis=0))
            energy.append((meets * loud[pose, row]).sum(axis=0) / witness.sum(axis=0).clip(1))
        return np.concatenate(energy), np.concatenate(sounding) >= MIN_POSES

    def _rows(self, points: Floats) -> tuple[Floats, Ints, Bools]:
        """Return each pose's distance to each place, and the slice it falls in, (P, N)."""
        distance = cdist(self.sources, points).clip(1e-9)
        row = np.round((distance - self.range[0]) / self.step).astype(np.int64)
        within = (row >= 0) & (row < len(self.range))
        return distance, row.clip(0, len(self.range) - 1), within

    def _witnesses(self, points: Floats, distance: Floats) -> Bools:
        local = [
            np.einsum("pi,ni->pn", self.rotations[:, :, axis], points)
            - (self.rotations[:, :, axis] * self.sources).sum(1)[:, None]
            for axis in range(3)
        ]
        rows, columns = self.witness_gain.shape
        azimuth = np.arctan2(local[1], local[0])
        elevation = np.arcsin((local[2] / distance).clip(-1, 1))
        row = np.round((elevation / np.pi + 0.5) * (rows - 1)).astype(np.int64)
        column = np.round((azimuth / (2 * np.pi) + 0.5) * (columns - 1)).astype(np.int64)
        return np.asarray(self.witness_gain[row, column])

    def box(self) -> Floats:
        """Return the box around all that explains the echoes, (2, 3) m, with a margin.

        The margin is two range resolutions, or half of the longest side if that is less.
        """
        # The box of a flight along a line or on one side: as far ahead as it hears, and to the
        # sides.
        looks = np.array([[3, 0, 0], [3, 2, 0], [3, -2, 0], [3, 0, 2], [3, 0, -2]])  # 34 degrees
        looks = looks / np.linalg.norm(looks, axis=1, keepdims=True)
        last = self.range[self.heard.shape[1] - 1 - self.heard[:, ::-1].argmax(axis=1)]
        ahead = [self.sources + self.rotations @ look * last[:, None] for look in looks]
        ends = np.concatenate((self.sources, *ahead))
        lower, upper = ends.min(axis=0), ends.max(axis=0)
        for _ in range(LOOKS):  # coarse to fine
            spacing = float((upper - lower).max()) / COARSE
            axes = [
                np.arange(a + spacing / 2, b + spacing / 2, spacing)
                for a, b in zip(lower, upper, strict=True)
            ]
            points = np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1).reshape(-1, 3)
            kept = points[self.needed(points, spacing * np.sqrt(3) / 2)]
            if not len(kept):
                raise NumericalError(NOTHING)
            lower, upper = kept.min(axis=0) - spacing / 2, kept.max(axis=0) + spacing / 2
        margin = min(2.0 * self.resolution, 0.5 * float((upper - lower).max()))
        return np.stack((lower - margin, upper + margin))

    def needed(self, points: Floats, tolerance: float) -> Bools:
        """Return the places that explain the echoes, the best focused first, (N,).

        Places in free air also lie at the range of echoes of many poses, but the echoes do not
        agree there. So the places with the best agreement are taken, the sound that they explain is
        removed, and the rest is examined again until little is left. Finally the origins of onsets
        without one are added, however faint their echoes are.
        """
        keep = np.zeros(len(points), dtype=bool)
        inside = self._inside(points, tolerance)
        covered = np.zeros_like(self.heard)
        for _ in range(ROUNDS):
            energy, enough = self._energy(points, tolerance, np.where(covered, 0.0, self.power))
            energy = np.where(inside & enough, energy, 0.0)
            taken = keep | (energy >= AGREEMENT * energy.max()) if energy.max() > 0 else keep
            if int(taken.sum()) == int(keep.sum()):
                break
            keep, covered = taken, self._covered(points[taken], tolerance)
            if self.power[~covered].sum() <= UNEXPLAINED * self.power.sum():
                break
        return self._with_origins(points, tolerance, keep, covered, inside)

    def _with_origins(
        self, points: Floats, tolerance: float, keep: Bools, covered: Bools, inside: Bools
    ) -> Bools:
        has_onset = np.isfinite(self.first)
        row = np.round((np.where(has_onset, self.first, 0.0) - self.range[0]) / self.step)
        row = row.astype(int).clip(0, len(self.range) - 1)
        pose = np.arange(len(row))
        while True:
            asks = np.flatnonzero(has_onset & ~covered[pose, row])
            if len(asks) <= max(MIN_POSES, UNEXPLAINED * has_onset.sum()):
                return keep
            agree = np.where(inside & ~keep, self._shared(points, tolerance, asks), 0)
            if agree.max() <= MIN_POSES:
                return keep
            keep = keep | (agree >= AGREEMENT * agree.max())
            covered = self._covered(points[keep], tolerance)

    def _shared(self, points: Floats, tolerance: float, asks: NDArray[np.intp]) -> Floats:
        """Return the number of the onsets that each place explains, (N,)."""
        parts = []
        for start in range(0, len(points), CHUNK):
            distance = cdist(self.sources, points[start : start + CHUNK]).clip(1e-9)
            witness = self._witnesses(points[start : start + CHUNK], distance)[asks]
            near = np.abs(distance[asks] - self.first[asks, None]) <= tolerance + self.step
            parts.append((witness & near).sum(axis=0))
        return np.concatenate(parts)

    def _covered(self, points: Floats, tolerance: float) -> Bools:
        """Return the mask (P, R) of the slices that the places explain."""
        covered = np.zeros_like(self.heard)
        for start in range(0, len(points), CHUNK):
            _, row, within = self._rows(points[start : start + CHUNK])
            pose = np.broadcast_to(np.arange(len(row))[:, None], row.shape)
            covered[pose[within], row[within]] = True
        half_width = int(np.ceil((tolerance + self.resolution) / self.step))
        behind = int(np.ceil(self.tail / self.step / 2.0))
        covered = ndimage.maximum_filter1d(
            covered, 2 * (half_width + behind) + 1, axis=1, mode="constant", origin=behind
        )
        return np.asarray(covered)


MIN_POSE_FRACTION = 0.02
"""Fraction of the poses that must hear an echo at a range or beyond it for it to count, no unit."""


def echo_extent(
    power: Floats, axis: Floats, looks: float, margin: float, ahead: Floats | None = None
) -> tuple[float, float]:
    """Return the least and the greatest range (m) that hold echoes, with a margin.

    In: power (P, E, R), axis ((R,), m), margin (m), ahead (L,). Out: limits ((float, float), m).
    """
    loud: Bools = power > threshold_levels(power, looks, ahead).total
    heard = np.asarray(loud.any(axis=1))  # (P, R)
    some = np.asarray(heard.any(axis=1))
    if not some.any():
        return float(axis[0]), float(axis[-1])
    first = axis[heard[some].argmax(axis=1)]
    last = axis[heard.shape[1] - 1 - heard[some, ::-1].argmax(axis=1)]
    low, high = np.quantile(first, MIN_POSE_FRACTION), np.quantile(last, 1.0 - MIN_POSE_FRACTION)
    return max(float(low - margin), float(axis[0])), min(float(high + margin), float(axis[-1]))
