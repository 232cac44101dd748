# SPDX-License-Identifier: MIT
"""Paths over several mirror points of curved surfaces, which Newton's method finds."""

from __future__ import annotations

import math
from collections.abc import Iterable
from dataclasses import dataclass

import numpy as np
from scipy.spatial import cKDTree

from sononerf.geometry.raycast import RayCaster
from sononerf.numerics import Bools, Floats, Ints
from sononerf.simulation.footprint import emit_bundles, expand_paths
from sononerf.simulation.paths import Bounce, joined, trace

MIN_BEND = 1e5
"""Phase by which a path would bend over the cap under which the emitter sees the scene, in the
direction in which it bends less, rad, from which the integral around its mirror point is taken in
closed form: the first Fresnel zone is then a 16,000th of the cap. With less, three spheres differ
more from exact echoes; with more, more rays are needed."""
ITERATIONS = 8
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
    """Last mirror points of paths to some places."""

    bounce: Bounce  # The hits of rays close to them
    which: Ints  # (N,): Index of the place
    longer: Floats  # (N,), m: Length of the paths less that by these hits
    root: Floats  # (N,), m/rad²: Root of the determinant of the path's second derivatives
    negative: Ints  # (N,): Number of negative eigenvalues of those derivatives

    def __getitem__(self, chosen: Bools) -> MirrorPoints:
        """Return the chosen ones."""
        return MirrorPoints(
            self.bounce[np.flatnonzero(chosen)],
            self.which[chosen],
            self.longer[chosen],
            self.root[chosen],
            self.negative[chosen],
        )


class MirrorSearch:
    r"""Mirror paths from one emitter, as stationary points of the path over the ray's direction.

    Where a surface is so curved that the bundle of a ray is far wider than the first Fresnel zone,
    a sum over rays would need very many of them. There the integral that :class:`~.rays.Rays` sums
    is known by stationary phase: a mirror point with the cross-section :math:`A` (m²/sr) of the
    bundle, the Hessian :math:`H` of the path over the ray's direction (m/rad²), and the distance
    :math:`r_2` to the ear brings the pressure

    .. math:: \frac{\sqrt{A}}{r_2 \sqrt{|\det H|}}\, j^n\, e^{-j k L}

    with :math:`n` negative eigenvalues and the path's length :math:`L`, times the gains and
    strengths there.

    In: emitter ((3,), m), wavenumber (rad/m), cap (sr): Solid angle of all rays that start, rays:
    Their number.

    Attributes:
        sharpest (m/rad²): Second derivative of a path above which it is one of these, and no sum.
    """

    def __init__(
        self, caster: RayCaster, emitter: Floats, *, wavenumber: float, cap: float, rays: int
    ) -> None:
        self._caster, self._emitter = caster, emitter
        self._wavenumber, self._solid_angle = wavenumber, cap / rays
        self.sharpest = MIN_BEND / (wavenumber * cap)

    def starts(
        self, bounces: Iterable[Bounce], places: Floats, body: Ints
    ) -> dict[int, tuple[Floats, Ints]]:
        """Return directions (N, 3) of rays near mirror paths, and the places (N,) these lead to.

        In: places ((L, 3), m), body (T,): Index of each triangle's connected part. Out: by number
        of bounces.
        """
        near: dict[int, list[tuple[Floats, Ints]]] = {}
        parts = int(body.max()) + 1
        for bounce in bounces:
            key = body[bounce.triangles[:, 0]]
            for column in bounce.triangles.T[1:]:
                key = key * parts + body[column]
            side = np.sqrt(np.broadcast_to(bounce.solid_angle, len(key)))
            for place in range(len(places)):
                which = np.full(len(key), place)
                u, v, detour, *_, least, _ = self._expanded(bounce, places, which)
                sharp = least > self.sharpest
                chosen = sharp & (np.hypot(u, v) < NEAR * side)
                order = np.flatnonzero(sharp)
                order = order[np.lexsort((detour[order], key[order]))]
                count = np.arange(len(order))
                first = np.where(np.diff(key[order], prepend=-1) != 0, count, 0)
                chosen[order[count - np.maximum.accumulate(first) < PER_SEQUENCE]] = True
                ray = np.flatnonzero(chosen)
                near.setdefault(bounce.number, []).append((bounce.emitted[ray], which[ray]))
        return {
            number: (np.concatenate([one for one, _ in some]), np.concatenate([n for _, n in some]))
            for number, some in near.items()
        }

    def both_ways(
        self, number: int, directions: Floats, places: Floats, which: Ints
    ) -> MirrorPoints | None:
        """As :meth:`refine`, and again from the directions of the last mirror points.

        A place close to the emitter hears each path in both directions. Where it is far, the way
        back is no more than a direction to start from.
        """
        there = self.refine(number, directions, places, which)
        if there is None:
            return None
        back = there.bounce.points - self._emitter
        back /= np.linalg.norm(back, axis=1, keepdims=True)
        both = np.concatenate([there.bounce.emitted, back])
        return self.refine(number, both, places, np.tile(there.which, 2))

    def refine(
        self, number: int, directions: Floats, places: Floats, which: Ints
    ) -> MirrorPoints | None:
        """Return the mirror points that Newton's method finds; None if there are none.

        In: number: Of bounces, directions (N, 3) to start from, places ((L, 3), m), which (N,):
        Index of the place that each leads to.
        """
        longest = LONGEST_STEP * math.sqrt(self._solid_angle)
        start, step = directions, np.zeros((len(directions), 3))
        done: list[tuple[Bounce, Ints]] = []
        for _ in range(ITERATIONS):
            if not len(start):
                break
            now = start + step
            now /= np.sqrt(np.einsum("nd,nd->n", now, now))[:, None]
            bounce = self._last(now, number)
            if bounce is None:
                step = 0.5 * step
                continue
            goal = which[bounce.ray]
            u, v, detour, *_ = self._expanded(bounce, places, goal)
            near = self._wavenumber * detour < CONVERGED
            arrived, further = np.flatnonzero(near), np.flatnonzero(~near)
            if len(arrived):
                done.append((bounce[arrived], goal[arrived]))
            # Rays that miss go back half of the way.
            missed = np.ones(len(now), dtype=bool)
            missed[bounce.ray] = False
            u, v = u[further], v[further]
            size = np.minimum(longest / np.maximum(np.hypot(u, v), 1e-300), 1.0)
            frame = emit_bundles(bounce.emitted[further], np.ones(len(further)))[:, 6:]
            turn = (u * size)[:, None] * frame[:, :3] + (v * size)[:, None] * frame[:, 3:]
            start = np.concatenate([now[bounce.ray[further]], start[missed]])
            step = np.concatenate([turn, 0.5 * step[missed]])
            which = np.concatenate([goal[further], which[missed]])
        if not done:
            return None
        bounce, which = joined([one for one, _ in done]), np.concatenate([n for _, n in done])
        _, _, _, longer, root, negative, least, greatest = self._expanded(bounce, places, which)
        good = np.flatnonzero(least > self.sharpest)
        good = good[self._first_of_its_kind(bounce.emitted[good], which[good], greatest[good])]
        if not len(good):
            return None
        return MirrorPoints(
            bounce[good], which[good], longer[good], root[good], negative[good].astype(np.int64)
        )

    def _first_of_its_kind(self, directions: Floats, which: Ints, stiffness: Floats) -> Bools:
        """Return the mask of paths (N,) that differ from all before."""
        reach = np.sqrt(2.0 * SAME / (self._wavenumber * stiffness))
        first = np.ones(len(directions), dtype=bool)
        if len(directions) > 1:
            apart = np.column_stack([directions, 10.0 * which])  # those to other places are others
            pairs = cKDTree(apart).query_pairs(float(reach.max()), output_type="ndarray")
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

    def _expanded(self, bounce: Bounce, places: Floats, which: Ints) -> Floats:
        rows = bounce.footprint.rows
        return expand_paths(rows, bounce.points, bounce.flat, bounce.mirrored, places, which)
