# SPDX-License-Identifier: MIT
"""Outlines of bodies, and the sound that passes them: shadows that fade with the Fresnel zone."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any

import numpy as np
import trimesh
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from sononerf.array_types import Bools, Complexes, Floats, Ints
from sononerf.geometry.normals import CREASE, bodies, corner_normals, weight_gradients
from sononerf.geometry.raycast import Hits, RayCaster
from sononerf.simulation.audibility import RESOLVED_FREQUENCY
from sononerf.simulation.impulse_response import NODE_SPACING


class Outlines:
    """The edges of a mesh that may be the outline of an obstacle, seen from somewhere.

    Args:
        mesh: The scene.

    Attributes:
        body (T,): Which connected part a triangle belongs to.
        closed (T,): Whether that part has no rim.
        several: Whether there is more than one part, or any that is not convex.
    """

    def __init__(self, mesh: trimesh.Trimesh) -> None:
        vertices = np.asarray(mesh.vertices, dtype=np.float64)
        faces = np.asarray(mesh.faces, dtype=np.int64)
        pairs = np.asarray(mesh.face_adjacency, dtype=np.int64).reshape(-1, 2)
        used = np.asarray(mesh.edges_sorted)
        _, first, count = np.unique(used, axis=0, return_index=True, return_counts=True)
        rim = first[count == 1]
        owner = np.asarray(mesh.edges_face, dtype=np.int64)[rim]
        self.body: Ints = bodies(mesh)
        parts = int(self.body.max()) + 1
        is_open = np.zeros(parts, dtype=bool)
        is_open[self.body[owner]] = True
        self.closed: Bools = ~is_open[self.body]
        ends = np.concatenate([np.asarray(mesh.face_adjacency_edges).reshape(-1, 2), used[rim]])
        self._normals = np.asarray(mesh.face_normals, dtype=np.float64)
        self._height = np.einsum("td,td->t", self._normals, vertices[faces[:, 0]])
        self._pairs = np.concatenate([pairs, np.stack([owner, owner], axis=1)])
        self._rim = np.arange(len(self._pairs)) >= len(pairs)
        self._ends, self._vertices = ends, vertices
        self._middles = vertices[faces].mean(axis=1)
        convex = np.asarray(mesh.face_adjacency_convex, dtype=bool)
        normals = corner_normals(mesh)
        self._second, self._third = weight_gradients(vertices[faces])
        self._bend = normals[:, 1:] - normals[:, :1]
        sharp = np.asarray(mesh.face_adjacency_angles) >= CREASE
        self._sharp = np.concatenate([sharp, np.ones(len(rim), dtype=bool)])
        self._size = float(np.linalg.norm(vertices.max(axis=0) - vertices.min(axis=0)))
        self.bounds = vertices.min(axis=0), vertices.max(axis=0)
        self._outward = np.concatenate(
            [convex | ~self.closed[pairs[:, 0]], np.ones(len(rim), dtype=bool)]
        )
        self.several = parts > 1 or bool(is_open.any()) or not mesh.is_convex

    def seen_from(self, place: Floats) -> tuple[Floats, Floats, Ints, Floats]:
        """Return outline edges as seen from a place.

        Returns:
            ends ((K, 2, 3), m): The obstacle lies on the left as one goes from the first to the
                second.
            away (K, 3): Unit vectors off the surface.
            body (K,): Of each edge.
            radius ((K,), m): Of the surface's curvature along the way from the place; zero where it
                is sharp.
        """
        front = self._normals @ place > self._height
        one, two = self._pairs.T
        chosen = np.flatnonzero(((front[one] != front[two]) | self._rim) & self._outward)
        one, two = one[chosen], two[chosen]
        facing = np.where(front[one], one, two)
        ends = self._vertices[self._ends[chosen]]
        inward = self._middles[facing] - ends[:, 0]
        left = np.cross(ends[:, 1] - ends[:, 0], inward)
        turned = np.einsum("kd,kd->k", left, place - ends[:, 0]) < 0.0
        ends[turned] = ends[turned, ::-1]
        away = self._normals[one] + self._normals[two]
        rim = self._rim[chosen]
        along = ends[rim, 1] - ends[rim, 0]
        square = np.einsum("kd,kd->k", along, along)
        square = np.einsum("kd,kd->k", along, inward[rim]) / np.maximum(square, 1e-300)
        away[rim] = square[:, None] * along - inward[rim]
        length = np.linalg.norm(away, axis=1, keepdims=True)
        radius = self._radius(one, two, ends.mean(axis=1) - place)
        radius[self._sharp[chosen]] = 0.0
        return ends, away / np.maximum(length, 1e-300), self.body[facing], radius

    def _radius(self, one: Ints, two: Ints, along: Floats) -> Floats:
        """Radius of curvature along a direction, the mean of two triangles."""
        along = along / np.linalg.norm(along, axis=1, keepdims=True)
        bend = np.zeros(len(one))
        for triangle in (one, two):
            turn = np.zeros_like(along)
            for corner, gradient in enumerate((self._second, self._third)):
                share = np.einsum("kd,kd->k", gradient[triangle], along)
                turn += share[:, None] * self._bend[triangle, corner]
            bend += 0.5 * np.einsum("kd,kd->k", turn, along)
        return 1.0 / np.maximum(bend, 1.0 / self._size)


CELL = 0.25
"""Size of a piece of surface with one obstacle factor, over the root of wavelength times the radius
of the scene, which is the width of the first Fresnel zone. Finer cells changed little."""
LONGEST = 0.4 / NODE_SPACING
"""Longest detour over an outline that is kept, s; longer ones turn too fast between the nodes."""
STEPS = 12
"""Steps per wavelength in which detours are sorted."""
LAYERS = 3
"""Surfaces that a ray through an obstacle may pass: into it, out of it, and one more."""
UNKNOWN = -2
"""Number of a cell that has not been solved for."""
LEAST = 0.02
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
    r"""By how much obstacles change the sound between one place and the surface.

    Fresnel's integral over what an obstacle leaves free, as one along its outline [1]_: with
    :math:`\varphi` the angle about the straight way and :math:`\delta` the detour over the outline,

    .. math:: T = H + \frac{1}{2 \pi} \oint e^{-j k \delta}\, d\varphi

    where :math:`H` is one in the light and zero in the shadow. At a straight border it is the knife
    edge: -6 dB on the border, a fading shadow on one side, overshoot on the other.

    A smooth obstacle of the radius :math:`a` along the way sends more around itself, by what the
    rigid surface adds to a knife edge [2]_, per length of the outline

    .. math:: -\frac{m}{\sqrt{\pi}\, d'} q^*(m \vartheta)\, e^{-j k \delta}, \qquad
        m = (k a / 2)^{1/3}, \quad 1 / d' = 1 / d_1 + 1 / d_2

    with :math:`\vartheta` the angle by which the sound bends and :math:`q^*` Pekeris' function. In
    the light it is faded out: there it is what bounces off the obstacle.

    What passes is the same over a cell of the surface, and solved for where it is asked for.

    Args:
        outlines: Of the scene.
        caster: Of the scene.
        place ((3,), m): Emitter or ear.
        wavenumber ((F,), 1/m): At the nodes.
        speed_of_sound (m/s): Of the air.
        size (m): Of the scene.

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
        self._cell = CELL * math.sqrt(wavelength * size)
        self._longest = LONGEST * speed_of_sound
        self._step = wavelength / STEPS
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
        key: Ints = (at[:, 0] * self._shape[1] + at[:, 1]) * self._shape[2] + at[:, 2]
        return key

    def passed(
        self, points: Floats, triangle: Ints
    ) -> tuple[NDArray[np.int32], NDArray[np.complex64]]:
        """Return the row (N,) of each point in a table (C, F) of what passes; -1: no outline near.

        Args:
            points ((N, 3), m): On the surface.
            triangle (N,): On which.
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

    @property
    def none(self) -> bool:
        """Whether nothing throws a shadow on anything."""
        return self._pieces is None

    def level(self, points: Floats, triangle: Ints) -> Floats:
        """Return the most that passes (N,) at any frequency to points in the shadow."""
        row, table = self.passed(points, triangle)
        most = np.append(np.abs(table).max(axis=1, initial=0.0), 0.0)
        level: Floats = most[row]
        return level

    def _solve(self, points: Floats, body: Ints) -> NDArray[np.int32]:
        pieces = self._pieces
        assert pieces is not None
        way = points - self._place
        distance = np.linalg.norm(way, axis=1)
        way /= distance[:, None]
        # The detour over an outline seen at the angle a is a² / 2 (1 / d1 - 1 / d).
        room = np.maximum(1.0 / self._nearest - 1.0 / distance, 0.0)
        angle = np.sqrt(2.0 * self._longest * room)
        reached = self._tree.query_ball_point(
            way, 2.0 * np.sin(0.5 * np.minimum(angle, math.pi)), return_sorted=False
        )
        count = np.array([len(found) for found in reached], dtype=np.int64)
        rows = np.full(len(points), -1, dtype=np.int32)
        if not count.any():
            return rows
        point = np.repeat(np.arange(len(points)), count)
        piece = np.concatenate([np.asarray(found, dtype=np.int64) for found in reached])
        towards = pieces.middle[piece] - self._place
        ahead = way[point]
        far = distance[point]
        before = np.einsum("nd,nd->n", towards, ahead)
        after = far - before
        behind = pieces.behind[piece]
        own = pieces.body[piece] == body[point]
        counts = (after > self._cell) & (before > 0.0)
        counts &= np.where(
            own, np.abs(far - behind) < 0.5 * (behind - before), behind > before + 0.5 * after
        )
        across = towards - before[:, None] * ahead
        square = np.einsum("nd,nd->n", across, across)
        detour = np.sqrt(before**2 + square) + np.sqrt(after**2 + square) - far
        chosen = np.flatnonzero(counts & (detour < self._longest))
        if len(chosen) == 0:
            return rows
        point, piece, ahead = point[chosen], piece[chosen], ahead[chosen]
        across, before, after = across[chosen], before[chosen], after[chosen]
        half = 0.5 * pieces.along[piece]
        half -= np.einsum("nd,nd->n", half, ahead)[:, None] * ahead
        one, two = across - half, across + half
        cross = -np.einsum("nd,nd->n", np.cross(one, two), ahead)
        swept = np.arctan2(cross, np.einsum("nd,nd->n", one, two))
        r1, r2 = (np.sqrt(np.einsum("nd,nd->n", end, end)) for end in (one, two))
        # Where the bisector of the angle meets the piece.
        radius = 2.0 * r1 * r2 * np.cos(0.5 * swept) / np.maximum(r1 + r2, 1e-300)
        detour = np.sqrt(before**2 + radius**2) + np.sqrt(after**2 + radius**2) - before - after
        place = np.minimum(detour / self._step, len(self._turns) - 2.0)
        index = place.astype(np.int64)
        share = place - index
        used, point = np.unique(point, return_inverse=True)
        size = len(used) * len(self._turns)
        at = point * len(self._turns) + index

        def lay(weight: Floats) -> Floats:
            laid: NDArray[Any] = np.bincount(at, weight * (1.0 - share), size)
            laid += np.bincount(at + 1, weight * share, size)
            table: Floats = laid.reshape(len(used), -1)
            return table

        lit = self._caster.visible(points[used] - self._cell * way[used], self._place)
        found = lit[:, None] + _product(lay(swept), self._turns)
        curve = pieces.curve[piece]
        if curve.any():
            # How far the way is in the shadow, as an angle by which sound bends.
            length = 2.0 * np.sqrt(np.einsum("nd,nd->n", half, half))
            reduced = before * after / (before + after)
            bent = cross / np.maximum(length, 1e-300) / reduced
            grazing = np.maximum(curve * self._waist, 1e-300)
            weight = length / reduced * curve * np.clip(1.0 + bent * grazing / LIT, 0.0, 1.0)
            bent = np.minimum(bent, SHADED / grazing) * curve
            for factor in self._creep:
                found += _product(lay(weight), factor)
                weight = weight * bent
        rows[used] = len(self._table) + np.arange(len(used))
        self._table = np.concatenate([self._table, found.astype(np.complex64)])
        return rows


def _product(real: Floats, factor: Complexes) -> Complexes:
    """Multiply a real matrix by a complex one, without making the real one complex."""
    product: Complexes = (real @ factor.view(np.float64)).view(np.complex128)
    return product


def behind(
    caster: RayCaster, outlines: Outlines, hits: Hits, directions: Floats
) -> tuple[Hits, Floats]:
    """Return what rays would hit beyond the first obstacle, and the whole ways (M,) there, m."""
    ray, points, length = hits.ray, hits.points, hits.distance
    found: list[tuple[Hits, Floats]] = []
    for _ in range(LAYERS):
        along = directions.take(ray, axis=0)
        further = caster.first_hit(points + caster.lift * along, along)
        along = along.take(further.ray, axis=0)
        length = length.take(further.ray) + further.distance
        ray = ray.take(further.ray)
        # Of a closed body the inner side is no surface.
        into = np.einsum("nd,nd->n", along, further.flat) < 0.0
        good = into | ~outlines.closed[further.triangle]
        kept = np.flatnonzero(good)
        found.append((_chosen(further, kept, ray), length[kept]))
        left = np.flatnonzero(~good)
        ray, points, length = ray[left], further.points[left], length[left]
        if len(ray) == 0:
            break
    hidden = [part for part in found if len(part[1])] or found[:1]
    joined = Hits(
        *(
            np.concatenate([getattr(part, name) for part, _ in hidden], axis=axis)
            for name, axis in (
                ("ray", 0), ("points", 0), ("normals", 0), ("triangle", 0), ("distance", 0),
                ("flat", 0), ("gradients", 2),
            )
        )
    )  # fmt: skip
    return joined, np.concatenate([way for _, way in hidden])


def _chosen(hits: Hits, kept: Ints, ray: Ints) -> Hits:
    return Hits(
        ray[kept],
        hits.points[kept],
        hits.normals[kept],
        hits.triangle[kept],
        hits.distance[kept],
        hits.flat[kept],
        hits.gradients[:, :, kept],
    )
