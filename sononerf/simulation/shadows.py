# SPDX-License-Identifier: MIT
"""Shadows: the sound that passes obstacles, fading with the Fresnel zone."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from sononerf.geometry.raycast import RayCaster
from sononerf.numerics import Bools, Complexes, Floats, Ints, compiled
from sononerf.simulation.diffraction import Outlines
from sononerf.simulation.hearing import RESOLVED_FREQUENCY
from sononerf.simulation.impulse_response import NODE_SPACING

CELL_SIZE = 0.25
"""Size of a piece of surface with one obstacle factor, over the root of wavelength times the radius
of the scene, which is the width of the first Fresnel zone. Finer cells changed little."""
MAX_DETOUR = 0.4 / NODE_SPACING
"""Longest detour over an outline that is kept, s; longer ones turn too fast between the nodes."""
DETOUR_STEPS = 12
"""Steps per wavelength in which detours are sorted."""
UNKNOWN = -2
"""Index of a cell that has not been solved for."""
MIN_FACTOR = 0.02
"""Obstacle factor below which nothing is heard, -34 dB."""
PEKERIS = (-0.2660 - 0.1478j, 0.1392 + 0.2246j, -0.0010 - 0.0536j)
"""Pekeris' function q* of a rigid surface as a polynomial of its argument, fitted within 0.013
from -0.6 to 1.8; time as e^{jwt}."""
LIT, SHADED = 1.2, 1.8
"""Arguments of that function at which it has faded out in the light, and is held in the shadow."""


@dataclass(frozen=True, eq=False)
class _Pieces:
    middle: Floats
    along: Floats
    behind: Floats
    body: Ints
    curve: Floats


class Shadow:
    r"""Change of the sound between one place and the surface by obstacles.

    Fresnel's integral over the area that an obstacle leaves free, as an integral along its outline
    [1]_: with
    :math:`\varphi` the angle about the straight way and :math:`\delta` the detour over the outline,

    .. math:: T = H + \frac{1}{2 \pi} \oint e^{-j k \delta}\, d\varphi

    where :math:`H` is one in the light and zero in the shadow. At a straight border it is the knife
    edge: -6 dB on the border, a fading shadow on one side, overshoot on the other.

    More sound passes around a smooth obstacle of the radius :math:`a` along the way. The rigid
    surface adds to a knife edge [2]_, per length of the outline,

    .. math:: -\frac{m}{\sqrt{\pi}\, d'} q^*(m \vartheta)\, e^{-j k \delta}, \qquad
        m = (k a / 2)^{1/3}, \quad 1 / d' = 1 / d_1 + 1 / d_2

    with :math:`\vartheta` the angle by which the sound bends and :math:`q^*` Pekeris' function. In
    the light it is faded out: there it is what bounces off the obstacle.

    What passes is the same over a cell of the surface, and solved for where it is asked for.

    In: place ((3,), m), wavenumber ((F,), 1/m), speed_of_sound (m/s), size (m).

    References:
        .. [1] A. Rubinowicz, "Thomas Young and the theory of diffraction", Nature 180, 1957.
        .. [2] P. H. Pathak, "An asymptotic analysis of the scattering of plane waves by a smooth
           convex cylinder", Radio Science 14, 1979.
    """

    def __init__(
        self,
        outlines: Outlines,
        caster: RayCaster,
        place: Floats,
        *,
        wavenumber: Floats,
        speed_of_sound: float,
        size: float,
    ) -> None:
        self._caster, self._place, self._outlines = caster, place, outlines
        wavelength = speed_of_sound / RESOLVED_FREQUENCY
        self._cell = CELL_SIZE * math.sqrt(wavelength * size)
        self._longest = MAX_DETOUR * speed_of_sound
        self._step = wavelength / DETOUR_STEPS
        bins = math.ceil(self._longest / self._step) + 2
        detour = np.arange(bins) * self._step
        taper = np.clip(2.0 * (1.0 - detour / self._longest), 0.0, 1.0)
        taper = np.square(np.sin(0.5 * math.pi * taper))
        self._turns = taper[:, None] * np.exp(-1j * np.multiply.outer(detour, wavenumber))
        waist = np.cbrt(0.5 * wavenumber)
        self._creep = [
            self._turns * (-q / math.sqrt(math.pi) * waist ** (1 + power))
            for power, q in enumerate(PEKERIS)
        ]
        self._turns /= 2.0 * math.pi
        self._waist = float(np.cbrt(math.pi / wavelength))
        lower, upper = outlines.bounds
        # Counted from the middle: the same for a scene turned by a right angle, or mirrored.
        half = np.floor(0.5 * (upper - lower) / self._cell + 0.5)
        self._shape = 2 * half.astype(np.int64) + 1
        self._low = 0.5 * (lower + upper) - (half + 0.5) * self._cell
        self._rows = np.full(int(self._shape.prod()), UNKNOWN, dtype=np.int32)
        self._table = np.zeros((0, len(wavenumber)), dtype=np.complex64)
        self._pieces = self._cut() if outlines.several else None
        if self._pieces is not None:
            towards = self._pieces.middle - place
            distance = np.linalg.norm(towards, axis=1)
            self._nearest = float(distance.min())
            self._tree = cKDTree(towards / distance[:, None])

    def _cut(self) -> _Pieces | None:
        """Outline edges that are seen and have room behind them, joined to pieces of a cell."""
        ends, away, body, radius = self._outlines.seen_from(self._place)
        middle = ends.mean(axis=1)
        free = self._caster.visible(middle, self._place, normals=away)
        ends, away, body, middle = ends[free], away[free], body[free], middle[free]
        radius = radius[free]
        onward = middle - self._place
        range_ = np.linalg.norm(onward, axis=1)
        onward /= np.maximum(range_, 1e-300)[:, None]
        hits = self._caster.first_hit(middle + self._caster.lift * away, onward)
        behind = np.full(len(middle), np.inf)
        behind[hits.ray] = range_[hits.ray] + hits.distance
        kept = behind - range_ > self._cell
        ends, body, behind, curve = ends[kept], body[kept], behind[kept], np.cbrt(radius[kept])
        if len(ends) == 0:
            return None
        along = ends[:, 1] - ends[:, 0]
        length = np.linalg.norm(along, axis=1)
        parts = np.maximum(np.ceil(length / self._cell), 1.0).astype(np.int64)
        owner = np.repeat(np.arange(len(parts)), parts)
        step = np.arange(len(owner)) - np.repeat(np.cumsum(parts) - parts, parts)
        share = (step + 0.5) / parts[owner]
        middle = ends[owner, 0] + share[:, None] * along[owner]
        along, length = along[owner] / parts[owner, None], length[owner] / parts[owner]
        body, behind, curve = body[owner], behind[owner], curve[owner]
        parts_of = self._outlines.body.max() + 1
        _, group = np.unique(self._key(middle) * parts_of + body, return_inverse=True)
        count = group.max() + 1
        weight = np.maximum(np.bincount(group, length, count), 1e-300)

        def total(values: Floats) -> Floats:
            return np.stack([np.bincount(group, column, count) for column in values.T], axis=1)

        middle = total(middle * length[:, None]) / weight[:, None]
        least = np.full(count, np.inf)
        np.minimum.at(least, group, behind)
        of = np.zeros(count, dtype=np.int64)
        of[group] = body
        curve = np.bincount(group, curve * length, count) / weight
        return _Pieces(middle, total(along), least, of, curve)

    def _key(self, points: Floats) -> Ints:
        at = ((points - self._low) * (1.0 / self._cell)).astype(np.int64)
        np.clip(at, 0, self._shape - 1, out=at)
        return (at[:, 0] * self._shape[1] + at[:, 1]) * self._shape[2] + at[:, 2]

    def passed(
        self, points: Floats, triangle: Ints
    ) -> tuple[NDArray[np.int32], NDArray[np.complex64]]:
        """Return the row (N,) of each point in a table (C, F) of transmission; -1: no outline near.

        In: points ((N, 3), m), triangle (N,).
        """
        if self._pieces is None or len(points) == 0:
            return np.full(len(points), -1, dtype=np.int32), self._table
        key = self._key(points)
        row = self._rows[key]
        new = np.flatnonzero(row == UNKNOWN)
        if len(new):
            count: NDArray[Any]
            middle: Floats
            keys, first, of = np.unique(key[new], return_index=True, return_inverse=True)
            count = np.bincount(of)
            middle = np.stack([np.bincount(of, column) / count for column in points[new].T], axis=1)
            body = self._outlines.body[triangle[new[first]]]
            self._rows[keys] = self._solve(middle, body)
            row[new] = self._rows[key[new]]
        return row, self._table

    def _solve(self, points: Floats, body: Ints) -> NDArray[np.int32]:
        pieces = self._pieces
        assert pieces is not None
        direction = points - self._place
        distance = np.linalg.norm(direction, axis=1)
        direction /= distance[:, None]
        # The detour over an outline seen at the angle a is a² / 2 (1 / d1 - 1 / d).
        room = np.maximum(1.0 / self._nearest - 1.0 / distance, 0.0)
        angle = np.sqrt(2.0 * self._longest * room)
        reached = self._tree.query_ball_point(
            direction, 2.0 * np.sin(0.5 * np.minimum(angle, math.pi)), return_sorted=False
        )
        count = np.array([len(near) for near in reached], dtype=np.int64)
        rows = np.full(len(points), -1, dtype=np.int32)
        if not count.any():
            return rows
        laid, used = _lay(
            points, self._place, body, np.cumsum([0, *count]),
            np.concatenate([np.asarray(near, dtype=np.int64) for near in reached]),
            pieces.middle, pieces.along, pieces.behind, pieces.body, pieces.curve,
            len(self._turns), self._step, self._cell, self._longest, self._waist,
        )  # fmt: skip
        if len(used) == 0:
            return rows
        lit = self._caster.visible(points[used] - self._cell * direction[used], self._place)
        passed = lit[:, None] + _product(laid[0], self._turns)
        for weight, factor in zip(laid[1:], self._creep, strict=True):
            if weight.any():
                passed += _product(weight, factor)
        rows[used] = len(self._table) + np.arange(len(used))
        self._table = np.concatenate([self._table, passed.astype(np.complex64)])
        return rows


@compiled
def _lay(
    points: Floats,
    place: Floats,
    bodies: Ints,
    start: Ints,
    reached: Ints,
    middles: Floats,
    alongs: Floats,
    behinds: Floats,
    owners: Ints,
    curves: Floats,
    bins: int,
    step: float,
    cell: float,
    longest: float,
    waist: float,
) -> tuple[Floats, Ints]:
    """Sort the sound from pieces of an outline to points by its detour.

    In: points ((N, 3), m), place ((3,), m), bodies (N,), start (N + 1,), reached (R,), step (m).
    Out: laid (4, U, bins), used (U,).
    """
    table = np.zeros((4, len(points), bins))
    is_used = np.zeros(len(points), np.bool_)
    ahead, across, half = np.zeros(3), np.zeros(3), np.zeros(3)
    one, two = np.zeros(3), np.zeros(3)
    for i in range(len(points)):
        far = 0.0
        for k in range(3):
            ahead[k] = points[i, k] - place[k]
            far += ahead[k] * ahead[k]
        far = math.sqrt(far)
        for k in range(3):
            ahead[k] /= far
        for at in range(start[i], start[i + 1]):
            piece = reached[at]
            before = 0.0
            for k in range(3):
                across[k] = middles[piece, k] - place[k]
                before += across[k] * ahead[k]
            after, behind = far - before, behinds[piece]
            if not (after > cell and before > 0.0):
                continue
            if owners[piece] == bodies[i]:
                if not abs(far - behind) < 0.5 * (behind - before):
                    continue
            elif not behind > before + 0.5 * after:
                continue
            square, off = 0.0, 0.0
            for k in range(3):
                across[k] -= before * ahead[k]
                square += across[k] * across[k]
                half[k] = 0.5 * alongs[piece, k]
                off += half[k] * ahead[k]
            detour = math.sqrt(before * before + square) + math.sqrt(after * after + square) - far
            if not detour < longest:
                continue
            length, r1, r2, inner = 0.0, 0.0, 0.0, 0.0
            for k in range(3):
                half[k] -= off * ahead[k]
                one[k], two[k] = across[k] - half[k], across[k] + half[k]
                length += half[k] * half[k]
                r1 += one[k] * one[k]
                r2 += two[k] * two[k]
                inner += one[k] * two[k]
            cross = -(one[1] * two[2] - one[2] * two[1]) * ahead[0]
            cross -= (one[2] * two[0] - one[0] * two[2]) * ahead[1]
            cross -= (one[0] * two[1] - one[1] * two[0]) * ahead[2]
            swept = math.atan2(cross, inner)
            r1, r2 = math.sqrt(r1), math.sqrt(r2)
            # Where the bisector of the angle meets the piece.
            radius = 2.0 * r1 * r2 * math.cos(0.5 * swept) / max(r1 + r2, 1e-300)
            detour = math.sqrt(before**2 + radius**2) + math.sqrt(after**2 + radius**2) - far
            along = min(detour / step, bins - 2.0)
            bin_ = int(along)
            late = along - bin_
            table[0, i, bin_] += swept * (1.0 - late)
            table[0, i, bin_ + 1] += swept * late
            is_used[i] = True
            curve = curves[piece]
            if curve == 0.0:
                continue
            # Depth of the way in the shadow, as the angle by which sound bends.
            length = 2.0 * math.sqrt(length)
            reduced = before * after / (before + after)
            bent = cross / max(length, 1e-300) / reduced
            grazing = max(curve * waist, 1e-300)
            weight = length / reduced * curve * min(max(1.0 + bent * grazing / LIT, 0.0), 1.0)
            bent = min(bent, SHADED / grazing) * curve
            for power in range(1, 4):
                table[power, i, bin_] += weight * (1.0 - late)
                table[power, i, bin_ + 1] += weight * late
                weight *= bent
    used = np.flatnonzero(is_used)
    return table[:, used].copy(), used


@compiled
def passing(
    lit: NDArray[np.int32],
    lit_table: NDArray[np.complex64],
    is_lit: Bools,
    heard: NDArray[np.int32],
    heard_table: NDArray[np.complex64],
    is_seen: Bools,
) -> tuple[Bools, Ints, NDArray[np.complex64]]:
    """Return the transmission past obstacles on the ways to points and on from there.

    In: lit, heard (N,), lit_table, heard_table (C, F), is_lit, is_seen (N,). Out: passes (N,), dim
    (M,), passed (M, F).
    """
    frequencies = lit_table.shape[1]
    passes = np.zeros(len(lit), np.bool_)
    dim, count, kept = np.zeros(len(lit), np.int64), 0, 0
    passed = np.zeros((len(lit), frequencies), np.complex64)
    for i in range(len(lit)):
        if not ((is_lit[i] or lit[i] >= 0) and (is_seen[i] or heard[i] >= 0)):
            continue
        if lit[i] >= 0 or heard[i] >= 0:
            loudest = 0.0
            for k in range(frequencies):
                factor = np.complex64(1.0)
                if lit[i] >= 0:
                    factor *= lit_table[lit[i], k]
                if heard[i] >= 0:
                    factor *= heard_table[heard[i], k]
                passed[kept, k] = factor
                loudest = max(loudest, float(factor.real**2 + factor.imag**2))
            if not loudest > MIN_FACTOR**2:
                continue
            dim[kept] = count
            kept += 1
        passes[i] = True
        count += 1
    return passes, dim[:kept].copy(), passed[:kept].copy()


def _product(real: Floats, factor: Complexes) -> Complexes:
    """Multiply a real matrix by a complex one, without making the real one complex."""
    return (real @ factor.view(np.float64)).view(np.complex128)
