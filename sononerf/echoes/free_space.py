# SPDX-License-Identifier: MIT
"""Free space: no part of a body lies nearer to a pose than the pose's first echo.

In: ranges of first echoes (P, E), m. Out: how far a place lies behind them, m. The nearest point of
a body always sends an echo, be it a smooth surface, an edge or a corner. What is left is to sound
what the visual hull [1]_ is to silhouettes. An onset that is an outlier has weight zero and rules
nothing out. Section 2 of ``docs/method.md``.

References:
    .. [1] A. Laurentini, "The visual hull concept for silhouette-based image understanding", 1994.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from typing import ClassVar

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy import sparse

from sononerf.geometry.meshes import Plane
from sononerf.numerics import Bools, Floats, compiled
from sononerf.resources import available_cores, in_threads

UNDETECTED = 0.05
"""Fraction of the onsets that may be wrong together where a place is judged, no unit; also the
fraction of outliers that are expected to stay undetected. With 0.02, on a thin leaf where every
twelfth onset is late, right onsets are blamed for ruling out what late ones hide."""
SHARE = 0.5
"""Largest number of onsets that rule a place out, as a fraction of the onsets at whose range the
place lies, no unit. Up to it the place is kept, and those that rule it out may all be late. Right
onsets meet at the place that they come from; late onsets scatter. Of a cone heard from above 23 of
200 poses miss the tip. With 0.5 and 1 these are removed and no others; with 2 seven right ones go
too."""
AT_ONCE = 6_400_000
"""Largest number of points times onsets in one array: memory then does not grow with the poses."""


@dataclass(frozen=True, eq=False)
class EchoHull:
    """Places that the first echoes leave: the complement of the free space."""

    emitters: Floats  # (P, 3), m: Places of the emitter at each pose, world frame
    receivers: Floats  # (P, E, 3), m: Places of the ears
    # (P, E), m: Range of the first echo that each ear heard: half of the way out and back; minus
    # infinity without evidence
    first: Floats
    axes: Floats  # (P, 3): Looking directions of the heads, unit vectors
    # Least cosine between a pose's axis and the direction to a place that its onset can rule out
    within: float = -1.0
    # (P, E) or None: Weight of each first echo, from 0 (outlier) to 1; all 1 where None
    weight: Floats | None = None
    # The support, below which there is no body; None if there is no support
    plane: Plane | None = None

    ARRAYS: ClassVar = ("emitters", "receivers", "first", "axes", "within", "weight")
    """Names of the attributes that a run saves as arrays."""

    def __post_init__(self) -> None:
        if self.weight is None:
            object.__setattr__(self, "weight", np.isfinite(self.first).astype(np.float64))

    @property
    def inlier_onsets(self) -> Floats:
        """Range of the first echoes of weight above zero, (P, E) m; else minus infinity."""
        assert self.weight is not None
        return np.where(self.weight > 0.0, self.first, -np.inf)

    @property
    def undetected(self) -> int:
        """Expected number of outliers among the onsets with weight above zero."""
        assert self.weight is not None
        detected = (np.isfinite(self.first) & (self.weight == 0.0)).any(axis=1).sum()
        return int(UNDETECTED * detected)

    @property
    def sources(self) -> Floats:
        """Half way between emitter and ears, (P, 3) m."""
        return (self.emitters + self.receivers.mean(axis=1)) / 2

    @property
    def width(self) -> float:
        """Largest distance of a pose from the straight line that fits all poses best, m."""
        off = self.sources - self.sources.mean(axis=0)
        along = np.linalg.svd(off, full_matrices=False)[2][0]
        return float(np.linalg.norm(off - np.outer(off @ along, along), axis=1).max())

    @property
    def chunk(self) -> int:
        """Number of points that are processed at once."""
        return max(AT_ONCE // max(self.first.size, 1), 1)

    def with_images(self) -> EchoHull:
        """Return the hull of body and image, heard by the poses and by their images.

        On a support sound comes to and from images as if there were two bodies and no support.
        """
        if self.plane is None:
            return self
        plane = self.plane
        return EchoHull(
            np.concatenate([self.emitters, plane.mirrored(self.emitters)]),
            np.concatenate([self.receivers, plane.mirrored(self.receivers)]),
            np.concatenate([self.first, self.first]),
            np.concatenate([self.axes, self.axes @ plane.reflection]),
            self.within,
            None if self.weight is None else np.concatenate([self.weight, self.weight]),
        )

    def clearance(self, points: ArrayLike) -> tuple[Floats, NDArray[np.intp]]:
        """Return the distance of points behind the first echoes, and the pose of the least one.

        In: points ((N, 3), m). Out: clearance ((N,), m), negative where an onset rules the point
        out and below the support, plus infinity without evidence; pose (N,).
        """
        where = np.asarray(points, dtype=np.float64)
        chunk = max(self.chunk // available_cores(), 1)  # all threads together hold one chunk
        some = [where[i : i + chunk] for i in range(0, len(where), chunk)]
        parts = in_threads(self._clearance, some)
        if not parts:
            return np.zeros(0), np.zeros(0, dtype=np.intp)
        return np.concatenate([c for c, _ in parts]), np.concatenate([p for _, p in parts])

    def behind(self, points: Floats) -> Floats:
        """Return the distance of points behind each first echo, (N, P, E) m.

        Plus infinity where it has no evidence about them.
        """
        return _behind(np.ascontiguousarray(points), *self._onsets)

    @property
    def _onsets(self) -> tuple[Floats, Floats, Floats, Floats, float]:
        """Arrays of the onsets: arguments of :func:`_behind`."""
        looks = np.broadcast_to(self.axes, self.emitters.shape)
        parts = (self.emitters, self.receivers, self.inlier_onsets, looks)
        emitters, receivers, first, axes = (np.array(part, dtype=np.float64) for part in parts)
        return emitters, receivers, first, axes, float(self.within)

    def _clearance(self, points: Floats) -> tuple[Floats, NDArray[np.intp]]:
        # Both ears bound the place: the nearer bound counts.
        left = self.behind(points).min(axis=2)
        spare = min(self.undetected, left.shape[1] - 1)
        pose = np.argpartition(left, spare, axis=1)[:, spare] if spare else left.argmin(axis=1)
        found = left[np.arange(len(points)), pose]
        if self.plane is not None:
            found = np.minimum(found, self.plane.height(points))
        return found, pose


@compiled
def _distance(point: Floats, place: Floats) -> float:
    x, y, z = point[0] - place[0], point[1] - place[1], point[2] - place[2]
    return math.sqrt(x * x + y * y + z * z)


@compiled
def _is_beside(
    point: Floats, emitter: Floats, axis: Floats, within: float, distance: float
) -> bool:
    """True if a point lies outside the cone in which an emitter is heard."""
    ahead = 0.0
    for k in range(3):
        ahead += (point[k] - emitter[k]) * axis[k]
    return within > -1.0 and ahead < within * distance


@compiled
def _behind(
    points: Floats, emitters: Floats, receivers: Floats, first: Floats, axes: Floats, within: float
) -> Floats:
    """Return the distance of points (N, 3) behind first echoes (P, E): (N, P, E), m.

    In: points ((N, 3), m), emitters, receivers ((P, 3), (P, E, 3), m), first ((P, E), m), axes (P,
    3).
    """
    behind = np.full((len(points), *first.shape), np.inf)
    for n in range(len(points)):
        for pose in range(len(first)):
            out = _distance(points[n], emitters[pose])
            if _is_beside(points[n], emitters[pose], axes[pose], within, out):
                continue
            for ear in range(first.shape[1]):
                back = _distance(points[n], receivers[pose, ear])
                behind[n, pose, ear] = 0.5 * (out + back) - first[pose, ear]
    return behind


@compiled
def _possible(
    cells: Floats,
    emitters: Floats,
    receivers: Floats,
    first: Floats,
    axes: Floats,
    within: float,
    chosen: Bools,
    few: int,
    share: float,
    tolerance: float,
) -> Bools:
    """Return the cells (N,) that few onsets rule out and that lie at the range of a wanted one.

    In: cells ((N, 3), m), chosen (P, E), reach (m).
    """
    is_possible = np.zeros(len(cells), np.bool_)
    for n in range(len(cells)):
        against, agree, meets = 0, 0, False
        for pose in range(len(first)):
            out = _distance(cells[n], emitters[pose])
            if _is_beside(cells[n], emitters[pose], axes[pose], within, out):
                continue
            for ear in range(first.shape[1]):
                back = _distance(cells[n], receivers[pose, ear])
                behind = 0.5 * (out + back) - first[pose, ear]
                if behind < -tolerance:
                    against += 1
                elif behind <= tolerance:
                    agree += 1
                    meets = meets or chosen[pose, ear]
        is_possible[n] = meets and against <= max(few, share * agree)
    return is_possible


ACCURACY = 0.1
"""Usual error of an onset's range, range resolutions. On simulated bodies half of all onsets err by
less than a twentieth of the resolution, and nearly all that are not late by less than a fifth."""

# Sizes of the search, which do not change its result: cells of the first lattice along the longest
# side, the
# greatest number of pairs of a cell and an onset, and how often the half diagonal of the last cells
# is halved down to the error of an onset.
COARSE, MOST_PAIRS, LEVELS = 24, 1.2e8, 4
OCTANTS = np.stack(np.meshgrid(*[[-0.25, 0.25]] * 3, indexing="ij"), axis=-1).reshape(-1, 3)


def weighted(hull: EchoHull, resolution: float, within: Floats | None = None) -> EchoHull:
    """Return the hull with weight zero for onsets that the others contradict.

    A first echo comes from a place at its range that no other onset rules out. If there is no such
    place, one of these onsets is wrong. An onset is *late* if the echo of a body's nearest point
    was too faint to be detected, such as the edge of a thin sheet beside the flash of its face; it
    then rules out places that several others heard. An onset is *early* if noise was taken for an
    echo; many others then rule out all places at its range.

    For each onset without an origin, the places at its range that the fewest others rule out are
    found, and each of these n others gets a blame of 1/n. An onset is an outlier if its blame
    reaches the number
    of ears, as if it alone contradicted a whole pose. The most blamed ones, down to half of the
    greatest blame, are removed, and so on until none is left. An onset whose places are all ruled
    out by more than a few, and by more than half as many as agree on the place (``SHARE``), is an
    outlier itself. Gross outliers are removed first, on coarse cells of places, so that fewer are
    left for the fine cells.

    In: resolution (m), within ((2, 3), m).
    """
    box, ears = _heard_box(hull) if within is None else within, hull.first.shape[1]
    if box is None:
        return hull
    error = ACCURACY * resolution
    for scale in 2.0 ** -np.arange(LEVELS):  # gross outliers first
        tolerance = error * scale * 2.0 ** (LEVELS - 1)
        weight = np.array(hull.weight).reshape(-1)
        heard = np.flatnonzero(weight)
        homeless = heard[~_cells(hull, box, heard, 0, 0.0, error, tolerance)[1].any(axis=0)]
        if len(homeless):
            few = max(int(UNDETECTED * scale * len(heard)), 4 * ears)
            against, meets = _cells(hull, box, homeless, few, SHARE, error, tolerance)
            _remove(weight, homeless, against, meets, float(ears))
            hull = replace(hull, weight=weight.reshape(hull.first.shape))
    return hull


def _remove(
    weight: Floats, homeless: NDArray[np.intp], against: Bools, meets: Bools, enough: float
) -> None:
    """Set the weight of outliers to zero; arrays as of ``_cells``."""
    count = against.sum(axis=1).astype(int)
    blocks = sparse.csr_matrix(against.astype(np.float64))
    while True:
        nowhere = len(weight) + 1
        least = np.where(meets, count[:, None], nowhere).min(axis=0, initial=nowhere)
        asks = np.flatnonzero((least > 0) & (least < nowhere) & (weight[homeless] > 0))
        if not len(asks):
            break
        origins = sparse.csr_matrix(
            (meets[:, asks] & (count[:, None] == least[asks])).astype(float)
        )
        lost = (origins.T @ blocks) > 0  # (asks, onsets)
        blame = np.asarray(lost.multiply(1.0 / least[asks][:, None]).sum(axis=0)).reshape(-1)
        blame[weight == 0] = 0.0
        worst = np.flatnonzero(blame >= max(enough, blame.max() / 2))
        if not len(worst):
            break
        weight[worst] = 0.0
        count -= against[:, worst].sum(axis=1)
    weight[homeless[least == nowhere]] = 0.0


def _heard_box(hull: EchoHull) -> Floats | None:
    """Return a box around where each first echo comes from if it lies ahead, (2, 3) m."""
    first = hull.inlier_onsets.max(axis=1)
    has_onset = np.isfinite(first)
    if not has_onset.any():
        return None
    ahead = hull.sources[has_onset] + hull.axes[has_onset] * first[has_onset, None]
    lower, upper = ahead.min(axis=0), ahead.max(axis=0)
    # To the sides as well: half of the mean range at least.
    middle, half = (lower + upper) / 2, (upper - lower) / 2
    half = np.maximum(half * 1.5, first[has_onset].mean() / 2)
    return np.stack((middle - half, middle + half))


def _cells(
    hull: EchoHull,
    box: Floats,
    chosen: NDArray[np.intp],
    few: int,
    share: float,
    error: float,
    least: float,
) -> tuple[Bools, Bools]:
    """Return cells at the range of wanted onsets that few others rule out, see ``_possible``.

    They are halved until half their diagonal is the least, m.

    Out: against (N, P E), meets (N, W).
    """
    lower, upper = box
    side = float((upper - lower).max()) / COARSE
    axes = [np.arange(a + side / 2, b + side / 2, side) for a, b in zip(lower, upper, strict=True)]
    cells = np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1).reshape(-1, 3)
    is_chosen = np.zeros(hull.first.size, dtype=np.bool_)
    is_chosen[chosen] = True
    while True:
        tolerance = float(side * np.sqrt(3) / 2 + error)
        of_chosen = is_chosen.reshape(hull.first.shape)
        if hull.plane is not None:
            cells = cells[hull.plane.height(cells) > -tolerance]
        cells = cells[_possible(cells, *hull._onsets, of_chosen, few, share, tolerance)]
        finer = 8.0 * len(cells) * hull.first.size
        if tolerance <= least + error or finer > MOST_PAIRS or not len(cells):
            break
        cells = (cells[:, None] + side * OCTANTS).reshape(-1, 3)
        side /= 2
    against, meets = [], []
    for start in range(0, max(len(cells), 1), hull.chunk):
        behind = hull.behind(cells[start : start + hull.chunk]).reshape(-1, hull.first.size)
        against.append(behind < -tolerance)
        meets.append(np.abs(behind[:, chosen]) <= tolerance)
    return np.concatenate(against), np.concatenate(meets)
