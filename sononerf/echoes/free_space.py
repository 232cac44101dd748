# SPDX-License-Identifier: MIT
"""The space that first echoes leave: nothing lies nearer to a pose than what it heard first.

The point of a body that is nearest to a pose faces it, be it part of a smooth surface, an edge or a
corner, so it always answers. What is nearer than a pose's first echo is therefore empty, whatever
the body's shape and however silent its faces are from elsewhere. What all poses leave is to sound
what the visual hull [1]_ is to silhouettes: for a convex body, heard from all around, its surface.
An onset that is known to be wrong has weight zero and rules nothing out.

References:
    .. [1] A. Laurentini, "The visual hull concept for silhouette-based image understanding", 1994.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.spatial.distance import cdist

Array = NDArray[np.float64]
UNDETECTED = 0.05
"""Fraction of the onsets that may be wrong together where a place is judged, and of outliers that
are not detected per detected one, no unit. On a thin leaf, where every twelfth onset is late, 0.02
blames right ones for ruling out what late ones hide."""
AT_ONCE = 6_400_000
"""Points times first echoes, so that memory does not grow with the poses."""


@dataclass(frozen=True, eq=False)
class EchoHull:
    """Where something can be, for all that first echoes tell.

    Attributes:
        emitters ((P, 3), m): Where each pose calls from, world frame.
        receivers ((P, E, 3), m): Where its ears are.
        first ((P, E), m): Range of the first echo that each ear heard: half of the way out and
            back; minus infinity where it tells nothing.
        axes (P, 3): Which way each head looks, unit vectors.
        within: A pose speaks for places towards which the cosine to its axis is at least this.
        weight ((P, E) or None): How far each first echo is trusted, from 0, an outlier that tells
            nothing, to 1; all of them where None.
    """

    emitters: Array
    receivers: Array
    first: Array
    axes: Array
    within: float = -1.0
    weight: Array | None = None

    def __post_init__(self) -> None:
        if self.weight is None:
            object.__setattr__(self, "weight", np.isfinite(self.first).astype(np.float64))

    @property
    def trusted(self) -> Array:
        """Range of the first echoes of weight above zero, (P, E) m; else minus infinity."""
        assert self.weight is not None
        return np.where(self.weight > 0.0, self.first, -np.inf)

    @property
    def undetected(self) -> int:
        """How many poses are expected to be outliers among those of weight above zero."""
        assert self.weight is not None
        detected = (np.isfinite(self.first) & (self.weight == 0.0)).any(axis=1).sum()
        return int(UNDETECTED * detected)

    @property
    def sources(self) -> Array:
        """Half way between emitter and ears, (P, 3) m."""
        middle: Array = (self.emitters + self.receivers.mean(axis=1)) / 2
        return middle

    @property
    def width(self) -> float:
        """How far poses lie from the straight line that fits them best, at most, m."""
        off = self.sources - self.sources.mean(axis=0)
        along = np.linalg.svd(off, full_matrices=False)[2][0]
        return float(np.linalg.norm(off - np.outer(off @ along, along), axis=1).max())

    @property
    def chunk(self) -> int:
        """How many points are looked at in one go."""
        return max(AT_ONCE // max(self.first.size, 1), 1)

    def clearance(self, points: ArrayLike) -> tuple[Array, NDArray[np.intp]]:
        """Return how far points lie behind the first echoes, and which pose leaves them least.

        Args:
            points ((N, 3), m): World frame.

        Returns:
            clearance ((N,), m): Negative where a pose says that nothing is there; plus infinity
                where none speaks. Its slope is at most one. So many poses as :attr:`undetected` may
                say so in vain.
            pose (N,): The pose that says so.
        """
        where = np.asarray(points, dtype=np.float64)
        chunk = self.chunk
        parts = [self._clearance(where[i : i + chunk]) for i in range(0, len(where), chunk)]
        if not parts:
            return np.zeros(0), np.zeros(0, dtype=np.intp)
        return np.concatenate([c for c, _ in parts]), np.concatenate([p for _, p in parts])

    def behind(self, points: Array) -> Array:
        """Return how far points lie behind each first echo, (N, P, E) m.

        Plus infinity where it tells nothing of them.
        """
        # No products of matrices: BLAS's threads wait for one another where a core is busy.
        out = cdist(points, self.emitters)
        first = self.trusted
        behind = np.stack(
            [
                (out + cdist(points, self.receivers[:, ear])) / 2 - first[:, ear]
                for ear in range(self.receivers.shape[1])
            ],
            axis=2,
        )
        if self.within > -1.0:
            ahead = np.einsum("ni,pi->np", points, self.axes)
            ahead -= (self.emitters * self.axes).sum(axis=1)
            behind[ahead < self.within * out] = np.inf
        return behind

    def _clearance(self, points: Array) -> tuple[Array, NDArray[np.intp]]:
        # Both ears bound the place: the nearer bound counts.
        left = self.behind(points).min(axis=2)
        spare = min(self.undetected, left.shape[1] - 1)
        pose = np.argpartition(left, spare, axis=1)[:, spare] if spare else left.argmin(axis=1)
        return left[np.arange(len(points)), pose], pose
