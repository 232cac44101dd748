# SPDX-License-Identifier: MIT
"""Unit vectors that cover the sphere or a cap of it evenly, and points that cover a surface."""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np
import trimesh
from numpy.typing import ArrayLike, NDArray

from sononerf.geometry.meshes import corner_normals
from sononerf.numerics import Bools, Floats, Ints, compiled

# Turning by the golden section of a circle never lets two neighbouring rings line up.
GOLDEN_TURN = (math.sqrt(5.0) - 1.0) / 2.0
PATCHES = (64, 128)  # of a cap, over its area and around its axis


def fibonacci_sphere(count: int) -> Floats:
    """Return unit vectors on a spiral from +z to -z, each standing for the same solid angle.

    Out: directions (D, 3).

    Examples:
        >>> abs(fibonacci_sphere(100).mean(axis=0)).max() < 0.01
        np.True_
    """
    return fibonacci_cap(count, axis=(0.0, 0.0, 1.0), half_angle=math.pi, offset=(0.5, 0.0))


def fibonacci_cap(
    count: int, *, axis: ArrayLike, half_angle: float, offset: tuple[float, float]
) -> Floats:
    """Return unit vectors on a spiral that fills the cap around an axis; equal areas, stratified.

    In: axis (3,), half_angle (rad), offset ((2,), 1). Out: directions (D, 3).
    """
    return CapSpiral(count, axis, half_angle, offset).directions()


@dataclass(frozen=True, eq=False)
class Cells:
    """Parallelograms on the plane of (share of a cap's area, turn about its axis)."""

    middles: Floats  # (2, N): Share and turn
    sides: Floats  # (2, 2, N): Two sides, each in share and turn
    parts: int  # Number of them in one cell of the spiral

    def __getitem__(self, chosen: NDArray[Any]) -> Cells:
        """Return the chosen cells."""
        return Cells(self.middles[:, chosen], self.sides[:, :, chosen], self.parts)

    def divided(self, split: int) -> Cells:
        """Divide each cell into ``split**2`` of one size."""
        steps = (np.arange(split) + 0.5) / split - 0.5
        middles = self.middles[:, :, None]
        for side in self.sides:
            moved = middles[..., None] + side[:, :, None, None] * steps
            middles = moved.reshape(*moved.shape[:2], -1)
        sides = np.repeat(self.sides / split, split**2, axis=2)
        return Cells(middles.reshape(2, -1), sides, self.parts * split**2)


@dataclass(frozen=True, eq=False)
class CapSpiral:
    """The pattern of :func:`fibonacci_cap`, which can be made denser where that is needed.

    In the coordinates (share of the cap's area, turn about the axis) the spiral is a lattice, so
    the parallelogram between neighbours is a cell of it, and cells can be divided evenly.
    """

    count: int  # Number of directions
    axis: ArrayLike  # (3,): The cap's middle; any length but zero
    half_angle: float  # rad: From the axis to the cap's rim, 0 to pi
    # (2,), 1: Shift within the ring's area, and turn of the whole pattern
    offset: tuple[float, float]
    rotation: Floats | None = None  # (3, 3): Turns the finished pattern, the axis with it

    def __post_init__(self) -> None:
        if self.count < 1:
            raise ValueError(f"count is {self.count}, expected one or more")
        if not 0.0 < self.half_angle <= math.pi:
            raise ValueError(f"half_angle is {self.half_angle}, expected above 0 and at most pi")

    @property
    def solid_angle(self) -> float:
        """Solid angle of one direction, sr."""
        return 2.0 * math.pi * self._depth / self.count

    @property
    def _depth(self) -> float:
        # 1 - cos(half_angle), written so that a narrow cap keeps its digits
        return 2.0 * math.sin(self.half_angle / 2.0) ** 2

    def directions(self, index: Ints | None = None) -> Floats:
        """Return the unit vectors (D, 3), from the axis outwards; all, or those of an index."""
        chosen = np.arange(self.count) if index is None else index
        return self._at(*self._lattice(chosen.astype(np.float64)))

    def reaching(self, towards: Floats, half_angle: Floats) -> Ints:
        """Return the indices, ascending, of all directions that lie in any of some cones.

        Others that lie near a cone are among them: whole patches of the cap are left out or not.

        In: towards (B, 3), half_angle ((B,), rad).
        """
        rows, columns = PATCHES
        edge, turn = np.arange(rows + 1) / rows, (np.arange(columns) + 0.5) / columns
        share = 0.5 * (edge[:-1] + edge[1:])
        middle = self._at(np.repeat(share, columns), np.tile(turn, rows))
        # From the middle of a patch its corners are farthest; those of one row are alike.
        aside = 0.5 / columns
        radius = np.zeros(rows)
        for ends in (edge[:-1], edge[1:]):
            corner = self._at(ends, np.full(rows, aside))
            apart = np.linalg.norm(corner - self._at(share, np.zeros(rows)), axis=1)
            radius = np.maximum(radius, 2.0 * np.arcsin(np.minimum(0.5 * apart, 1.0)))
        min_cosine = np.cos(np.minimum(half_angle + 1.1 * radius[:, None], math.pi)) - 1e-9
        near = (middle @ towards.T).reshape(rows, columns, -1) >= min_cosine[:, None]
        chosen: Bools = np.asarray(near.any(axis=2))
        return _in_patches(chosen, self.count, *self.offset)

    def neighbourhood(self, index: Ints) -> Ints:
        """Return directions' indices together with those of their four neighbours, sorted."""
        near, far = self.neighbour_steps(index)
        around = np.concatenate([index, index - near, index + near, index - far, index + far])
        return np.unique(around[(around >= 0) & (around < self.count)])

    def neighbour_steps(self, index: Ints) -> tuple[Ints, Ints]:
        """Return the two steps in index (N,) that lead to the nearest neighbours, either way."""
        return _cell_steps(self._ring(index), self._depth / self.count)

    def cells(self, index: Ints) -> Cells:
        """Return the cells of directions by their index (N,)."""
        share, turn = self._lattice(index.astype(np.float64))
        steps = np.stack(self.neighbour_steps(index))
        across = np.mod(steps * GOLDEN_TURN + 0.5, 1.0) - 0.5
        sides = np.stack([steps / self.count, across], axis=1)
        return Cells(np.stack([share, turn]), sides, 1)

    def towards(self, cells: Cells) -> Floats:
        """Return the unit vectors (N, 3) of the middles of cells."""
        return self._at(*cells.middles)

    def _lattice(self, index: Floats) -> tuple[Floats, Floats]:
        return (index + self.offset[0]) / self.count, index * GOLDEN_TURN + self.offset[1]

    def _ring(self, index: Ints) -> Floats:
        """Sine of the angle from the axis."""
        drop = self._depth * (index + self.offset[0]) / self.count
        return np.sqrt(drop * (2.0 - drop))

    def _at(self, share: Floats, turn: Floats) -> Floats:
        return _on_sphere(share, turn, self._depth, self._axes)

    @cached_property
    def _axes(self) -> Floats:
        """The frame of the pattern, its axis first."""
        axes = _frame(self.axis)
        return axes if self.rotation is None else axes @ self.rotation.T


@compiled
def _on_sphere(share: Floats, turn: Floats, depth: float, axes: Floats) -> Floats:
    """Return unit vectors (N, 3) at shares of a cap's area (N,) and turns about its axis (N,)."""
    directions = np.zeros((len(share), 3))
    for i in range(len(share)):
        drop, angle = depth * share[i], turn[i]  # 1 - cos(angle from the axis)
        # A cell may reach over the axis, or over the far pole, to the other side.
        if drop < 0.0 or drop > 2.0:
            drop = -drop if drop < 0.0 else 4.0 - drop
            angle += 0.5
        angle = 2.0 * math.pi * (angle - math.floor(angle))
        ring = math.sqrt(drop * (2.0 - drop))
        x, y, z = 1.0 - drop, ring * math.cos(angle), ring * math.sin(angle)
        for k in range(3):
            directions[i, k] = x * axes[0, k] + y * axes[1, k] + z * axes[2, k]
    return directions


@compiled
def _in_patches(chosen: Bools, count: int, shift: float, turn: float) -> Ints:
    """Return the indices of the directions in chosen patches (rows, columns), ascending."""
    rows, columns = chosen.shape
    index, count_inside = np.zeros(count, np.int64), 0
    for i in range(count):
        around = i * GOLDEN_TURN + turn
        around -= math.floor(around)
        row = min(int((i + shift) / count * rows), rows - 1)
        if chosen[row, min(int(around * columns), columns - 1)]:
            index[count_inside] = i
            count_inside += 1
    return index[:count_inside].copy()


def _cell_steps(ring: Floats, depth: float) -> tuple[Ints, Ints]:
    """Return the steps in index to the two neighbours that span the most compact cell.

    They are neighbouring Fibonacci numbers, which two depends on the distance from the axis; the
    cells they span have the same area everywhere.
    """
    numbers = [1, 1]
    while len(numbers) < 40:
        numbers.append(numbers[-1] + numbers[-2])
    step = np.array(numbers[1:], dtype=np.float64)
    across = 2.0 * math.pi * (np.mod(step * GOLDEN_TURN + 0.5, 1.0) - 0.5)
    square = (depth * step / np.maximum(ring, 1e-12)[:, None]) ** 2 + (ring[:, None] * across) ** 2
    best = (square[:, :-1] + square[:, 1:]).argmin(axis=1)
    return step[best].astype(np.int64), step[best + 1].astype(np.int64)


def _frame(axis: ArrayLike) -> Floats:
    """Return the axis as a unit vector and two that are square to it."""
    middle = np.asarray(axis, dtype=np.float64)
    length = np.linalg.norm(middle)
    if not length > 0.0:
        raise ValueError(f"axis is {middle}, expected a vector with a length")
    middle = middle / length
    helper = np.zeros(3)
    helper[np.argmin(np.abs(middle))] = 1.0
    side = np.cross(helper, middle)
    side /= np.linalg.norm(side)
    return np.stack([middle, side, np.cross(middle, side)])


POOL = 10  # points on the surface from which one is chosen
PLASTIC = 1.324717957244746  # root of x^3 = x + 1; its powers spread points over a square evenly


def spread_points(mesh: trimesh.Trimesh, count: int) -> tuple[Floats, Floats]:
    """Choose points of a surface, each as far as possible from those before it [1]_.

    So any first ones of them are spread evenly over the surface, whatever its triangles.

    Out: points ((N, 3), m), normals (N, 3).

    References:
        .. [1] T. F. Gonzalez, "Clustering to minimize the maximum intercluster distance",
           Theoretical Computer Science 38, 1985.
    """
    # A pool of points, as many on each part of the area, uniform over their triangles: Osada et
    # al., "Shape distributions", ACM TOG 21(4), 2002.
    pool = POOL * count
    end = np.cumsum(np.asarray(mesh.area_faces, dtype=np.float64))
    place = (np.arange(pool) + 0.5) / pool * end[-1]
    triangle = np.searchsorted(end, place).clip(max=len(end) - 1)
    first = np.mod(np.arange(pool) / PLASTIC, 1.0)
    second = np.mod(np.arange(pool) / PLASTIC**2, 1.0)
    root = np.sqrt(first)
    weights = np.stack([1.0 - root, root * (1.0 - second), root * second], axis=1)
    corners = np.asarray(mesh.triangles, dtype=np.float64)
    points = np.einsum("nc,ncd->nd", weights, corners[triangle])
    normals = np.einsum("nc,ncd->nd", weights, corner_normals(mesh)[triangle])
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    # Single precision suffices to tell which is farthest.
    single = (points - points.mean(axis=0)).astype(np.float32).T.copy()
    gap = np.full(pool, np.inf, dtype=np.float32)
    chosen = np.zeros(count, dtype=np.int64)
    for index in range(1, count):
        off = single - single[:, chosen[index - 1], None]
        np.minimum(gap, (off * off).sum(axis=0), out=gap)
        chosen[index] = gap.argmax()
    return points[chosen], normals[chosen]
