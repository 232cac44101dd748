# SPDX-License-Identifier: MIT
"""Paths over several mirror points of curved surfaces, path by Newton's method."""

from __future__ import annotations

import math
from collections.abc import Iterable
from dataclasses import dataclass

import numpy as np
from scipy.spatial import cKDTree

from sononerf.geometry.raycast import RayCaster
from sononerf.numerics import Bools, Floats, Ints
from sononerf.simulation.footprint import emit_bundles, path_derivatives
from sononerf.simulation.paths import Bounce, joined, trace

MIN_TURNS = 4.0
"""Phase by which a path bends over the cell of a ray, in the direction in which it bends less, rad,
from which the integral around its mirror point is known in closed form: the first Fresnel zone is
then smaller than the cell."""
ITERATIONS = 12
"""Newton steps."""
CONVERGED = 0.02
"""Phase between a ray and the mirror path below which it is one, rad."""
SAME = 0.5
"""Phase between two paths below which they are one, rad."""
LONGEST_STEP = 4.0
"""Longest Newton step, sides of the cell of a ray."""
NEAR = 2.0
"""Distance of a predicted mirror point from its ray up to which it is looked for, sides of its
cell."""
PER_SEQUENCE = 4
"""Rays over the same bodies, those with the shortest detours, from which one is looked for however
far it is."""


@dataclass(frozen=True, eq=False)
class MirrorPoints:
    """Last mirror points of paths to one listener."""

    bounce: Bounce  # The hits of rays close to them
    longer: (
        Floats  # (N,), m: By how much the paths are longer than by these hits; less than zero too
    )
    root: Floats  # (N,), m/rad²: Root of the determinant of the path's second derivatives
    negative: Ints  # (N,): Number of negative eigenvalues of those derivatives


@dataclass(frozen=True, eq=False)
class _Expansion:
    """A path's length about rays, to second order."""

    step: Floats  # (2, N), rad: To the mirror point
    detour: Floats  # (N,), m: Upper bound of the difference to the path by the mirror point
    longer: Floats  # As of the mirror points
    root: Floats
    negative: Ints
    least: Floats  # (N,), m/rad²: Eigenvalues' magnitudes, the smaller and the greater
    greatest: Floats


class MirrorSearch:
    r"""Mirror paths from one emitter, as stationary points of the path over the ray's direction.

    Where a surface is so curved that the bundle of a ray is far wider than the first Fresnel zone,
    a sum over rays would need very many of them. The integral :class:`~.rays.Rays` sums is known
    there, by stationary phase: a mirror point with the cross-section :math:`A` (m²/sr) of the
    bundle, the Hessian :math:`H` of the path over the ray's direction (m/rad²), and the distance
    :math:`r_2` to the ear brings the pressure

    .. math:: \frac{\sqrt{A}}{r_2 \sqrt{|\det H|}}\, j^n\, e^{-j k L}

    with :math:`n` negative eigenvalues and the path's length :math:`L`, times the gains and
    strengths there.

    In: wavenumber (rad/m), solid_angle (sr): Solid angle of a ray, emitter ((3,), m).

    Attributes:
        sharpest (m/rad²): Second derivative of a path above which it is one of these, and no sum.
    """

    def __init__(
        self, caster: RayCaster, emitter: Floats, *, wavenumber: float, solid_angle: float
    ) -> None:
        self._caster, self._emitter = caster, emitter
        self._wavenumber, self._solid_angle = wavenumber, solid_angle
        self.sharpest = MIN_TURNS / (wavenumber * solid_angle)

    def starts(self, bounces: Iterable[Bounce], listener: Floats, body: Ints) -> dict[int, Floats]:
        """Return directions (N, 3) of rays near mirror paths, by the number of bounces.

        In: listener ((3,), m), body (T,): Index of each triangle's connected part.
        """
        by_number: dict[int, list[Floats]] = {}
        for bounce in bounces:
            path = self._expand(bounce, listener)
            sharp = path.least > self.sharpest
            off = np.hypot(*path.step)
            side = np.sqrt(np.broadcast_to(bounce.solid_angle, off.shape))
            near = sharp & (off < NEAR * side)
            key = body[bounce.triangles[:, 0]]
            for column in bounce.triangles.T[1:]:
                key = key * (body.max() + 1) + body[column]
            order = np.flatnonzero(sharp)
            order = order[np.lexsort((path.detour[order], key[order]))]
            new = np.diff(key[order], prepend=-1) != 0
            since = np.arange(len(order)) - np.maximum.accumulate(
                np.where(new, np.arange(len(order)), 0)
            )
            near[order[since < PER_SEQUENCE]] = True
            by_number.setdefault(bounce.number, []).append(bounce.emitted[near])
        return {number: np.concatenate(parts) for number, parts in by_number.items()}

    def both_ways(self, number: int, directions: Floats, listener: Floats) -> MirrorPoints | None:
        """Return the mirror points that are reached from some directions (N, 3), or backwards.

        A listener close to the emitter hears each path in both directions. Where it is far, the
        way back is no more than a place to start from.
        """
        there = self.refine(number, directions, listener)
        if there is None:
            return None
        back = there.bounce.points - self._emitter
        back /= np.linalg.norm(back, axis=1, keepdims=True)
        return self.refine(number, np.concatenate([there.bounce.emitted, back]), listener)

    def refine(self, number: int, directions: Floats, listener: Floats) -> MirrorPoints | None:
        """Return the mirror points that Newton's method finds from some directions (N, 3)."""
        longest = LONGEST_STEP * math.sqrt(self._solid_angle)
        start, step = directions, np.zeros((len(directions), 3))
        done: list[Bounce] = []
        for _ in range(ITERATIONS):
            if not len(start):
                break
            now = start + step
            now /= np.linalg.norm(now, axis=1, keepdims=True)
            bounce = self._last(now, number)
            if bounce is None:
                step *= 0.5
                continue
            path = self._expand(bounce, listener)
            near = self._wavenumber * path.detour < CONVERGED
            done.append(bounce[np.flatnonzero(near)])
            # Rays that miss go back half of the way.
            missed = np.ones(len(now), dtype=bool)
            missed[bounce.ray] = False
            further = np.flatnonzero(~near)
            u, v = path.step[:, further]
            size = np.minimum(longest / np.maximum(np.hypot(u, v), 1e-300), 1.0)
            frame = emit_bundles(bounce.emitted[further], np.ones(len(further)))[:, 6:]
            turn = (u * size)[:, None] * frame[:, :3] + (v * size)[:, None] * frame[:, 3:]
            start = np.concatenate([now[bounce.ray[further]], start[missed]])
            step = np.concatenate([turn, 0.5 * step[missed]])
        kept = [bounce for bounce in done if len(bounce.ray)]
        if not kept:
            return None
        bounce = joined(kept)
        path = self._expand(bounce, listener)
        good = np.flatnonzero(path.least > self.sharpest)
        good = good[self._first_of_its_kind(bounce.emitted[good], path.greatest[good])]
        if not len(good):
            return None
        return MirrorPoints(bounce[good], path.longer[good], path.root[good], path.negative[good])

    def _first_of_its_kind(self, directions: Floats, stiffness: Floats) -> Bools:
        """Return the mask of paths (N,) that differ from all before."""
        reach = np.sqrt(2.0 * SAME / (self._wavenumber * stiffness))
        first = np.ones(len(directions), dtype=bool)
        if len(directions) > 1:
            pairs = cKDTree(directions).query_pairs(float(reach.max()), output_type="ndarray")
            one, other = directions[pairs[:, 0]], directions[pairs[:, 1]]
            alike = np.linalg.norm(one - other, axis=1) < reach[pairs].max(axis=1)
            first[pairs[alike].max(axis=1)] = False
        return first

    def _last(self, directions: Floats, number: int) -> Bounce | None:
        for bounce in trace(
            self._caster, self._emitter, directions, number, solid_angle=self._solid_angle
        ):
            if bounce.number == number:
                return bounce
        return None

    def _expand(self, bounce: Bounce, listener: Floats) -> _Expansion:
        _, _, _, g1, g2, h11, h22, h12 = path_derivatives(
            bounce.footprint.rows, bounce.points, bounce.flat, bounce.mirrored, listener
        )
        middle, half = 0.5 * (h11 + h22), np.hypot(0.5 * (h11 - h22), h12)
        one, other = middle + half, middle - half
        determinant = h11 * h22 - h12 * h12
        safe = np.where(np.abs(determinant) > 1e-300, determinant, 1e-300)
        u, v = (h12 * g2 - h22 * g1) / safe, (h12 * g1 - h11 * g2) / safe
        longer = 0.5 * (g1 * u + g2 * v)  # to second order, at the mirror point
        low, high = np.minimum(np.abs(one), np.abs(other)), np.maximum(np.abs(one), np.abs(other))
        detour = 0.5 * (u * u + v * v) * high
        return _Expansion(
            np.stack([u, v]), detour, longer, np.sqrt(np.abs(determinant)),
            (one < 0.0).astype(np.int64) + (other < 0.0), low, high,
        )  # fmt: skip
