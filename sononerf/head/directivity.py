# SPDX-License-Identifier: MIT
"""A measured directivity: gains of receivers, and perhaps of the emitter, over direction."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from scipy.sparse import csr_array
from scipy.spatial import ConvexHull, QhullError, cKDTree

from sononerf.errors import InputError
from sononerf.geometry.directions import fibonacci_sphere
from sononerf.numerics import Floats, Ints

FADE = math.radians(10.0)
"""Angle outside the measured area over which the gain falls to zero, rad."""
MAX_TRIANGLE_WIDTH = 3.0
"""Width of a triangle's circumscribed circle, over the usual width, above which the triangle
belongs to no measured area."""
BACKGROUND = 2000
"""Number of directions that fill the rest of the sphere, about 4.5 degrees apart."""
LEAST_SPACING, MOST_SPACING = math.radians(0.5), math.radians(12.0)
BULGE = 1e-4
"""The sphere is deformed by this fraction before it is triangulated. So the diagonals of the
cells of a regular grid do not depend on rounding or on the order of the directions."""
SAME_DIRECTION = 1e-6  # rad; directions nearer than this are one
CHUNK = 512


def interpolation(given: Floats, directions: Floats) -> csr_array:
    """Return weights that bring values from known directions to wanted ones.

    Directions are triangulated on the sphere. Within a triangle values are linear, so that measured
    directions are reproduced exactly. Beyond the measured area the value of the nearest measured
    direction is faded to zero.

    In: given (M, 3), directions (N, 3). Out: weights ((N, M) sparse float64).
    """
    cells = np.round(given / SAME_DIRECTION).astype(np.int64)
    _, first, same = np.unique(cells, axis=0, return_index=True, return_inverse=True)
    same = same.reshape(-1)
    counts = np.bincount(same)
    merge = csr_array((1.0 / counts[same], (same, np.arange(len(given)))))
    points = given[first]
    spacing = _spacing(points)
    tree = cKDTree(points)
    around = fibonacci_sphere(BACKGROUND)
    far, nearest = tree.query(around)
    outside = 2.0 * np.arcsin(np.minimum(far / 2.0, 1.0)) > MAX_TRIANGLE_WIDTH * spacing
    around, nearest = around[outside], nearest[outside]
    every = np.concatenate([points, around])
    # A direction that fills the rest has the value of the nearest measured one.
    source = np.concatenate([np.arange(len(points)), nearest])
    hull = _hull(every)
    triangles = np.asarray(hull.simplices, dtype=np.int64)
    measured = (triangles < len(points)).all(axis=1) & (
        _radius(every, triangles) <= MAX_TRIANGLE_WIDTH * spacing
    )
    facet, weights = _locate(every, hull, directions)
    off = 2.0 * np.arcsin(np.minimum(tree.query(directions)[0] / 2.0, 1.0)) - spacing
    fade = np.where(measured[facet], 1.0, np.clip(1.0 - off / FADE, 0.0, 1.0))
    rows = np.repeat(np.arange(len(directions)), 3)
    columns = source[triangles[facet]].reshape(-1)
    values = (weights * fade[:, None]).reshape(-1)
    return csr_array((values, (rows, columns)), shape=(len(directions), len(points))) @ merge


def _hull(points: Floats) -> ConvexHull:
    x, y, z = points.T
    radius = 1.0 + BULGE * (x * y + 0.7 * y * z + 0.4 * z * x + 0.3 * x * x + 0.1 * y * y)
    return ConvexHull(points * radius[:, None])


def _radius(points: Floats, triangles: Ints) -> Floats:
    """Return the angle from the centre of each circumscribed circle to its corners, rad."""
    a, b, c = (points[triangles[:, corner]] for corner in range(3))
    normal = np.cross(b - a, c - a)
    normal /= np.linalg.norm(normal, axis=1, keepdims=True).clip(1e-300)
    return np.asarray(np.arccos(np.clip(np.abs((normal * a).sum(axis=1)), 0.0, 1.0)))


def _spacing(points: Floats) -> float:
    """Return the usual radius of the circles that hold no measured direction, rad."""
    try:
        radius = float(np.median(_radius(points, _hull(points).simplices)))
    except (QhullError, ValueError):  # directions in one plane, or fewer than four
        radius = MOST_SPACING
        if len(points) > 1:
            nearest = cKDTree(points).query(points, k=2)[0][:, 1]
            radius = float(np.median(np.arcsin(np.minimum(nearest / 2.0, 1.0))))
    return min(max(radius, LEAST_SPACING), MOST_SPACING)


def _locate(points: Floats, hull: ConvexHull, directions: Floats) -> tuple[Ints, Floats]:
    """Return the facet that each direction runs through, and the weights (N, 3) of its corners.

    The hull encloses the origin: a ray from there leaves by the facet whose plane it meets first.
    """
    slope = hull.equations[:, :3] / -hull.equations[:, 3:]
    facet = np.concatenate([(part @ slope.T).argmax(axis=1) for part in _parts(directions)])
    corners = points[hull.simplices[facet]].transpose(0, 2, 1)
    weights = np.linalg.solve(corners, directions[:, :, None])[:, :, 0].clip(0.0)
    return facet, weights / weights.sum(axis=1, keepdims=True)


def _parts(directions: Floats) -> list[Floats]:
    return np.array_split(directions, max(1, math.ceil(len(directions) / CHUNK)))


MOST_RECEIVERS = 256
MIN_DIRECTIONS = 3
"""Number of directions below which they always lie in one plane."""
PLANAR_RATIO = 0.1
"""Thickness of a set of directions over its width below which it counts as a plane, no unit.
Elevations of a few degrees with azimuths all around are such a set."""


@dataclass(frozen=True, eq=False)
class Directivity:
    """Linear gains in the head frame (x forward, y left, z up)."""

    source: str  # Name of the source, for messages
    # (M, 3): Unit vectors from the head to where sound comes from or goes to, in any order
    directions: Floats
    frequency: Floats  # (F,), Hz: Ascending
    gains: Floats  # (E, M, F): Gains of each receiver, zero or more
    beam: Floats | None = None  # (M, F) or None: Beam of the emitter; None where the file has none
    # (E, 3) or None, m: Places of the receivers; None where the file does not state them
    places: Floats | None = None

    def __post_init__(self) -> None:
        self._check_shapes()
        named: dict[str, Floats] = {
            "frequencies": self.frequency,
            "directions": self.directions,
            "gains": self.gains,
        }
        if self.beam is not None:
            named["emitter's gains"] = self.beam
        if self.places is not None:
            named["places"] = self.places
        for name, values in named.items():
            if not np.isfinite(values).all():
                raise InputError(f"{self.source}: the {name} hold NaN or infinite values")
        if (np.diff(self.frequency) <= 0.0).any() or self.frequency[0] < 0.0:
            raise InputError(f"{self.source}: the frequencies do not ascend from 0 Hz or above")
        length = np.linalg.norm(self.directions, axis=1)
        if not np.allclose(length, 1.0, atol=1e-6):
            raise InputError(f"{self.source}: a direction is no unit vector")
        for name in ("gains", "emitter's gains"):
            least, most = (named[name].min(), named[name].max()) if name in named else (0.0, 1.0)
            if least < 0.0:
                raise InputError(
                    f"{self.source}: the {name} hold the negative value {least:.3g}; "
                    "expected linear gains of 0 or more"
                )
            if most == 0.0:
                raise InputError(f"{self.source}: the {name} are all zero")

    def _check_shapes(self) -> None:
        receivers = len(self.gains) if self.gains.ndim == 3 else 0
        expected = (len(self.directions), len(self.frequency))
        if not expected[0] or not expected[1]:
            raise InputError(f"{self.source}: holds no directions or no frequencies")
        if not 1 <= receivers <= MOST_RECEIVERS:
            raise InputError(
                f"{self.source}: holds {receivers} receivers, expected 1 to {MOST_RECEIVERS}"
            )
        found = {"gains": self.gains.shape[1:]}
        if self.beam is not None:
            found["emitter's gains"] = self.beam.shape
        for name, shape in found.items():
            if shape != expected:
                raise InputError(
                    f"{self.source}: the {name} have the shape {shape}, expected {expected} "
                    "(directions, frequencies)"
                )
        if self.places is not None and self.places.shape != (receivers, 3):
            raise InputError(
                f"{self.source}: states {len(self.places)} places of {receivers} receivers"
            )

    @property
    def is_flat(self) -> bool:
        """Whether all directions lie in one plane: a circle around the head was measured."""
        if len(self.directions) < MIN_DIRECTIONS:
            return False
        size = np.linalg.svd(self.directions, compute_uv=False) / math.sqrt(len(self.directions))
        return bool(size[2] < PLANAR_RATIO * size[1])

    def weights(self, directions: Floats) -> csr_array:
        """Return the weights (N, M) that bring gains to directions (N, 3); rows sum to 1 or less.

        Linear between measured directions; outside the measured area the nearest measured gain
        fades to zero over 10 degrees.
        """
        return interpolation(self.directions, directions)

    def at(self, frequency: Floats, values: Floats) -> Floats:
        """Return gains (..., M, F) at other frequencies (K,), (..., M, K).

        Linear between measured frequencies; outside of them the nearest measured one counts.
        """
        measured = self.frequency
        right = np.searchsorted(measured, frequency).clip(1, max(len(measured) - 1, 1))
        if len(measured) == 1:
            return np.repeat(values, len(frequency), axis=-1)
        left = right - 1
        part = ((frequency - measured[left]) / (measured[right] - measured[left])).clip(0.0, 1.0)
        return values[..., left] * (1.0 - part) + values[..., right] * part


def unit_vectors(azimuth: Floats, elevation: Floats) -> Floats:
    """Return unit vectors (..., 3) of azimuths (to the left) and elevations (up), rad.

    The two are broadcast against each other.
    """
    level = np.cos(elevation)
    parts = (level * np.cos(azimuth), level * np.sin(azimuth), np.sin(elevation))
    return np.stack(np.broadcast_arrays(*parts), axis=-1)
