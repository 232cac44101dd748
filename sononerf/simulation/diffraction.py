# SPDX-License-Identifier: MIT
"""Sound bent by edges and outlines: rigid wedges, and outlines seen against the background."""

from __future__ import annotations

import math
from dataclasses import dataclass, fields
from typing import Any

import numpy as np
import trimesh

from sononerf.geometry.directions import GOLDEN_TURN
from sononerf.geometry.meshes import CREASE, bodies, corner_normals, weight_gradients
from sononerf.geometry.raycast import RayCaster
from sononerf.numerics import Bools, Floats, Ints, compiled
from sononerf.scene.scene import Scene
from sononerf.simulation.hearing import Hearing, Sound
from sononerf.simulation.paths import Reflection


class Outlines:
    """Edges of a mesh that may be part of an obstacle's outline, seen from some place.

    Attributes:
        body (T,): Index of each triangle's connected part.
        closed (T,): True if that part has no rim.
        several: True if there are several parts, or one that is not convex.
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
        self._ends = vertices[ends]
        self._normals = np.asarray(mesh.face_normals, dtype=np.float64)
        self._height = np.einsum("td,td->t", self._normals, vertices[faces[:, 0]])
        self._pairs = np.concatenate([pairs, np.stack([owner, owner], axis=1)])
        self._rim = np.arange(len(self._pairs)) >= len(pairs)
        self._middles = vertices[faces].mean(axis=1)
        convex = np.asarray(mesh.face_adjacency_convex, dtype=bool)
        normals = corner_normals(mesh)
        self._second, self._third = weight_gradients(vertices[faces])
        self._bend = normals[:, 1:] - normals[:, :1]
        sharp = np.asarray(mesh.face_adjacency_angles) >= CREASE
        self._sharp = np.concatenate([sharp, np.ones(len(rim), dtype=bool)])
        self._size = float(np.linalg.norm(vertices.max(axis=0) - vertices.min(axis=0)))
        self.bounds = vertices.min(axis=0), vertices.max(axis=0)
        self._may = np.concatenate(
            [convex | ~self.closed[pairs[:, 0]], np.ones(len(rim), dtype=bool)]
        )
        self.several = parts > 1 or bool(is_open.any()) or not mesh.is_convex

    def seen_from(self, place: Floats) -> tuple[Floats, Floats, Ints, Floats]:
        """Return outline edges as seen from a place.

        Out: ends ((K, 2, 3), m), away (K, 3), body (K,), radius ((K,), m).
        """
        return _outline(
            place, self._normals, self._height, self._pairs, self._may, self._rim, self._sharp,
            self._ends, self._middles, self._second, self._third, self._bend, self.body,
            1.0 / self._size,
        )  # fmt: skip


@compiled
def _outline(
    place: Floats,
    normals: Floats,
    height: Floats,
    pairs: Ints,
    may: Bools,
    rims: Bools,
    sharp: Bools,
    edges: Floats,
    middles: Floats,
    second: Floats,
    third: Floats,
    bend: Floats,
    bodies: Ints,
    least: float,
) -> tuple[Floats, Floats, Ints, Floats]:
    """Return the edges between a triangle that faces a place and one that does not, and rims.

    In: place ((3,), m), normals (T, 3), height ((T,), m), pairs (K, 2), may, rims, sharp (K,),
    edges ((K, 2, 3), m), middles ((T, 3), m), second, third ((T, 3), 1/m), bend (T, 2, 3), bodies
    (T,), least (1/m).
    """
    front = np.zeros(len(normals), np.bool_)
    for i in range(len(normals)):
        n = normals[i]
        front[i] = n[0] * place[0] + n[1] * place[1] + n[2] * place[2] > height[i]
    count = 0
    for e in range(len(pairs)):
        if may[e] and (rims[e] or front[pairs[e, 0]] != front[pairs[e, 1]]):
            count += 1
    ends, away = np.zeros((count, 2, 3)), np.zeros((count, 3))
    body, radius = np.zeros(count, np.int64), np.zeros(count)
    a, b, inward, along = np.zeros(3), np.zeros(3), np.zeros(3), np.zeros(3)
    i = 0
    for e in range(len(pairs)):
        one, two = pairs[e, 0], pairs[e, 1]
        if not (may[e] and (rims[e] or front[one] != front[two])):
            continue
        facing = one if front[one] else two
        for k in range(3):
            a[k], b[k] = edges[e, 0, k], edges[e, 1, k]
            inward[k] = middles[facing, k] - a[k]
            along[k] = b[k] - a[k]
        side = (along[1] * inward[2] - along[2] * inward[1]) * (place[0] - a[0])
        side += (along[2] * inward[0] - along[0] * inward[2]) * (place[1] - a[1])
        side += (along[0] * inward[1] - along[1] * inward[0]) * (place[2] - a[2])
        square, product, length, far = 0.0, 0.0, 0.0, 0.0
        for k in range(3):
            ends[i, 0, k], ends[i, 1, k] = (b[k], a[k]) if side < 0.0 else (a[k], b[k])
            square += along[k] * along[k]
            product += along[k] * inward[k]
        for k in range(3):
            if rims[e]:
                away[i, k] = product / max(square, 1e-300) * along[k] - inward[k]
            else:
                away[i, k] = normals[one, k] + normals[two, k]
            length += away[i, k] * away[i, k]
            along[k] = 0.5 * (a[k] + b[k]) - place[k]
            far += along[k] * along[k]
        length, far = math.sqrt(length), math.sqrt(far)
        bent = 0.0
        for triangle in (one, two):
            share, other = 0.0, 0.0
            for k in range(3):
                share += second[triangle, k] * along[k] / far
                other += third[triangle, k] * along[k] / far
            for k in range(3):
                turn = share * bend[triangle, 0, k] + other * bend[triangle, 1, k]
                bent += 0.5 * turn * along[k] / far
        for k in range(3):
            away[i, k] /= max(length, 1e-300)
        body[i] = bodies[facing]
        if not sharp[e]:
            radius[i] = 1.0 / max(bent, least)
        i += 1
    return ends, away, body, radius


Array = Any
"""An array of NumPy, or a tensor."""
_LEAST = 1e-12  # keeps divisions and roots, and their gradients, finite


@dataclass(frozen=True, eq=False)
class Edges:
    """Edges at which a surface turns outwards, or ends."""

    ends: Floats  # (K, 2, 3), m: World frame
    away: Floats  # (K, 3): Unit vectors off the surface
    inward: Floats  # (K, 3): Unit vectors from the edge along one of its faces
    normal: Floats  # (K, 3): Outward normals of that face
    # (K,), rad: Angle of the air around the edge: pi for a plane, 2 pi where a sheet ends
    open_angle: Floats
    triangle: Ints  # (K,): Index of that face

    @property
    def length(self) -> Floats:
        """Length of each edge (K,), m."""
        return np.linalg.norm(self.ends[:, 1] - self.ends[:, 0], axis=1)

    def __getitem__(self, chosen: Ints) -> Edges:
        """Return the chosen edges."""
        return Edges(*(getattr(self, field.name)[chosen] for field in fields(self)))


def diffracting_edges(mesh: trimesh.Trimesh) -> Edges:
    """Return the edges of a mesh that are sharper than a crease, and convex or open."""
    vertices, faces = np.asarray(mesh.vertices, dtype=np.float64), np.asarray(mesh.faces)
    used, owner = np.asarray(mesh.edges_sorted), np.asarray(mesh.edges_face)
    # A triangle without area, however its corners lie, has no side to diffract on.
    thin = _thin(vertices[faces])
    _, first, count = np.unique(used, axis=0, return_index=True, return_counts=True)
    rim = first[count == 1]
    rim = rim[~thin[owner[rim]]]
    kept = np.flatnonzero(~thin)
    if thin.any():
        mesh = trimesh.Trimesh(vertices, faces[kept], process=False)
    normals = np.zeros((len(faces), 3))
    normals[kept] = mesh.face_normals
    angles = np.asarray(mesh.face_adjacency_angles)
    sharp = np.flatnonzero((angles >= CREASE) & np.asarray(mesh.face_adjacency_convex))
    pairs = kept[np.asarray(mesh.face_adjacency)[sharp]]
    ends = np.concatenate(
        [vertices[np.asarray(mesh.face_adjacency_edges)[sharp]], vertices[used[rim]]]
    )
    triangle = np.concatenate([pairs[:, 0], owner[rim]]).astype(np.int64)
    along = ends[:, 1] - ends[:, 0]
    along /= np.linalg.norm(along, axis=1, keepdims=True)
    middle = vertices[faces[triangle]].mean(axis=1)
    inward = middle - ends[:, 0]
    inward -= np.einsum("kd,kd->k", inward, along)[:, None] * along
    inward /= np.linalg.norm(inward, axis=1, keepdims=True)
    # At an edge of two faces back to back, the way off both is the way out of one.
    away = normals[pairs].sum(axis=1) - 1e-6 * inward[: len(pairs)]
    away = np.concatenate([away, -inward[len(pairs) :]])
    return Edges(
        ends,
        away / np.linalg.norm(away, axis=1, keepdims=True),
        inward,
        normals[triangle],
        np.concatenate([math.pi + angles[sharp], np.full(len(rim), 2.0 * math.pi)]),
        triangle,
    )


def _thin(corners: Floats) -> Bools:
    """Which triangles (T, 3, 3) are a millionth as high as long, or less."""
    sides = np.roll(corners, -1, axis=1) - corners
    longest = np.square(sides).sum(axis=2).max(axis=1)
    twice_area = np.linalg.norm(np.cross(sides[:, 0], sides[:, 1]), axis=1)
    return twice_area <= 1e-6 * longest


def wedge_directivity(
    inward: Array,
    normal: Array,
    open_angle: Array,
    to_source: Array,
    to_receiver: Array,
    fade: Array,
    xp: Any = np,
) -> Array:
    r"""Return the diffraction by the edge of a rigid wedge from a source to a receiver.

    .. math:: -\frac{\nu}{2} \sum_{\pm \pm}
        \frac{\sin \nu (\pi \pm \theta_1 \pm \theta_2)}
        {\cosh \nu \eta - \cos \nu (\pi \pm \theta_1 \pm \theta_2)}

    with :math:`\nu = \pi / \theta_w`; times :math:`dz / (2 \pi r_1 r_2)` it is the pressure of a
    stretch :math:`dz` of the edge, exact for an infinite wedge [1]_.

    Where one of the faces mirrors the source into the receiver the sum has a pole, and the mirror
    itself is there, fading out over the edge within :math:`1/k` of detour: see
    :meth:`Reflection.heard`. What it brings is taken from the term with that pole.

    In: inward, normal (N, 3), open_angle ((N,), rad), to_source, to_receiver ((N, 3), m), fade
    ((F,), 1/m). Out: directivity (N, F).

    References:
        .. [1] U. P. Svensson, R. I. Fred and J. Vanderkooy, "An analytic secondary source model of
           edge diffraction impulse responses", JASA 106, 1999, equations (5) to (7).
    """
    along = xp.linalg.cross(normal, inward)
    angles, heights, radii, distances = [], [], [], []
    for vector in (to_source, to_receiver):
        out, across = (xp.einsum("nd,nd->n", vector, axis) for axis in (normal, inward))
        angles.append(xp.remainder(xp.arctan2(out, across), 2.0 * math.pi))
        heights.append(xp.einsum("nd,nd->n", vector, along))
        radii.append(xp.clip(xp.hypot(out, across), _LEAST, None))
        distances.append(xp.sqrt(xp.einsum("nd,nd->n", vector, vector)))
    nu = math.pi / open_angle
    bent = (distances[0] * distances[1] + heights[0] * heights[1]) / (radii[0] * radii[1])
    hyperbolic = xp.cosh(nu * xp.arccosh(xp.clip(bent, 1.0 + _LEAST, None)))
    total = 0.0
    path = distances[0] + distances[1]
    square = xp.square(radii[0]) + xp.square(radii[1]) + xp.square(heights[0] - heights[1])
    for one in (-1.0, 1.0):
        for two in (-1.0, 1.0):
            angle = math.pi + one * angles[0] + two * angles[1]
            below = hyperbolic - xp.cos(nu * angle)
            term = (xp.sin(nu * angle) / xp.where(below > _LEAST, below, math.inf))[:, None]
            if one == two:
                both = (
                    angles[0] + angles[1] if one < 0.0 else 2.0 * open_angle - angles[0] - angles[1]
                )
                mirrored = square - 2.0 * radii[0] * radii[1] * xp.cos(both)
                detour = xp.clip(path - xp.sqrt(xp.clip(mirrored, _LEAST**2, None)), 0.0, None)
                term = -term * xp.expm1(-detour[:, None] * fade)
            total = total + term
    return -0.5 * nu[:, None] * total


EDGE_STEP = 0.25
"""Length of the stretches of an edge, and distance between the points of strongly curved places,
over the wavelength at ``RESOLVED_FREQUENCY``; half of it changes
echoes of bodies with flat faces by 0.1 dB."""
INSET = 0.02
"""Distance from an end of a stretch at which it is asked whether it is seen, over its length: at a
corner, what meets there would hide it."""
HALVINGS = 5
"""Bisections of a stretch that is seen in part; the border is then known to 1/64 of it."""


class Diffraction:
    r"""Points on edges and strongly curved places; each stands for what lies about it.

    The points are the same for all poses, as close as the wavelength needs. One on an edge stands
    for a stretch :math:`dM` of it; the curved places by :math:`M = \int s \kappa\, dA`, with the
    share :math:`s` at which the curvature :math:`\kappa` counts as strong. So the level depends on
    neither the points nor the triangles. A part :math:`dM` (m) of this adds the pressure

    .. math:: D\, \frac{dM}{2 \pi\, r_1 r_2}\, e^{-j k (r_1 + r_2)}\, B\, E

    where emitter and ear both see it, with the material's strength :math:`D`; on an edge :math:`D`
    is multiplied by the directivity of a rigid wedge.

    In: step (m): Greatest distance between points.
    """

    def __init__(
        self, scene: Scene, caster: RayCaster, reflections: tuple[Reflection, ...], *, step: float
    ) -> None:
        self._caster = caster
        self._strength = np.stack([reflection.diffraction for reflection in reflections])
        self._fade = reflections[0].fade  # the same for all materials
        faces = len(scene.mesh.faces)
        part = np.zeros(faces, dtype=np.int64) if scene.part is None else scene.part
        sounds = np.any(self._strength, axis=1)
        edges = diffracting_edges(scene.mesh)
        edges = edges[np.flatnonzero(sounds[part[edges.triangle]])]
        pieces = np.maximum(np.ceil(edges.length / step), 1.0).astype(np.int64)
        owner = np.repeat(np.arange(len(pieces)), pieces)
        at = np.arange(len(owner)) - np.repeat(np.cumsum(pieces) - pieces, pieces)
        along = (edges.ends[:, 1] - edges.ends[:, 0])[owner] / pieces[owner, None]
        self._edges = edges[owner]
        place = edges.ends[owner, 0] + (at + 0.5)[:, None] * along
        share = np.zeros(faces)
        for index, reflection in enumerate(reflections):
            of_part = part == index
            share[of_part] = sounds[index] * reflection.curved_share(caster.curvature[of_part])
        area = share * np.asarray(scene.mesh.area_faces, dtype=np.float64)
        turn = np.cumsum(caster.curvature * area)
        points = math.ceil(area.sum() / step**2) if turn[-1] > 0.0 else 0
        each = turn[-1] / max(points, 1)
        fraction = (np.arange(points) + 0.5) * each
        triangle = np.searchsorted(turn, fraction, side="right")
        fraction = 1.0 - (turn[triangle] - fraction) / np.diff(turn, prepend=0.0)[triangle]
        # Uniform over a triangle: Osada et al., "Shape distributions", ACM TOG 21(4), 2002.
        root, across = np.sqrt(fraction), np.mod(np.arange(points) * GOLDEN_TURN, 1.0)
        weights = np.stack([1.0 - root, root * (1.0 - across), root * across], axis=1)
        corners = np.asarray(scene.mesh.triangles, dtype=np.float64)[triangle]
        self._place = np.concatenate([place, np.einsum("nc,ncd->nd", weights, corners)])
        self._along = np.concatenate([along, np.zeros((points, 3))])
        self._away = np.concatenate([self._edges.away, caster.face_normals[triangle]])
        self._amount = np.concatenate([np.linalg.norm(along, axis=1), np.full(points, each)])
        self._part = part[np.concatenate([self._edges.triangle, triangle])]

    def sound(self, hearing: Hearing, position: Floats, rotation: Floats) -> Sound:
        """Return the sound of edges and curved places at the ears of a pose.

        In: position ((3,), m), rotation (3, 3).
        """
        sound = hearing.silence()
        if not len(self._place):
            return sound
        emitter, ears = hearing.places(position, rotation)
        lit = self._part_seen(np.arange(len(self._place)), emitter)
        chosen = np.flatnonzero(lit[1] > lit[0])
        lit = lit[:, chosen]
        emitted = self._place[chosen] - emitter
        length = np.linalg.norm(emitted, axis=1)
        emitted /= length[:, None]
        level = hearing.beam(emitted, rotation) * self._strength[self._part[chosen]]
        weight = self._amount[chosen] * hearing.speed_of_sound / (2.0 * math.pi)
        level *= (weight / length)[:, None]
        for ear, listener in enumerate(ears):
            heard = self._part_seen(chosen, listener)
            begin, end = np.maximum(lit[0], heard[0]), np.minimum(lit[1], heard[1])
            some = np.flatnonzero(end > begin)
            index, begin, end = chosen[some], begin[some], end[some]
            along = (end - begin)[:, None] * self._along[index]
            place = self._place[index] + (0.5 * (begin + end) - 0.5)[:, None] * self._along[index]
            to_emitter, to_ear = emitter - place, listener - place
            length = np.linalg.norm(to_emitter, axis=1)
            both = to_emitter / length[:, None] + to_ear / np.linalg.norm(to_ear, axis=1)[:, None]
            gain = level[some] * (end - begin)[:, None]
            edge = int(np.searchsorted(index, len(self._edges.triangle)))
            edges = self._edges[index[:edge]]
            gain[:edge] *= wedge_directivity(
                edges.inward, edges.normal, edges.open_angle, to_emitter[:edge], to_ear[:edge],
                self._fade,
            )  # fmt: skip
            hearing.add(
                sound,
                ear,
                place,
                length=length,
                spread=np.abs(np.einsum("nd,nd->n", along, both)) / math.sqrt(12.0),
                level=gain,
                position=position,
                rotation=rotation,
            )
        return sound

    def _part_seen(self, index: Ints, target: Floats) -> Floats:
        """Return where the part of each stretch that a target sees begins and ends (2, N), 0 to 1.

        Of a stretch with one end in the shadow, the border is found by bisection. A point that
        stands for a curved place is seen as a whole or not at all.
        """

        def seen(index: Ints, at: Floats) -> Bools:
            place = self._place[index] + (at - 0.5)[:, None] * self._along[index]
            return self._caster.visible(place, target, normals=self._away[index])

        first = seen(index, np.full(len(index), INSET))
        last = seen(index, np.full(len(index), 1.0 - INSET))
        begin, end = np.where(first, 0.0, 1.0), np.where(last, 1.0, 0.0)
        border = np.flatnonzero(first ^ last)
        low, high = np.zeros(len(border)), np.ones(len(border))
        for _ in range(HALVINGS):
            middle = 0.5 * (low + high)
            before = seen(index[border], middle) == first[border]
            low, high = np.where(before, middle, low), np.where(before, high, middle)
        middle = 0.5 * (low + high)
        begin[border] = np.where(first[border], 0.0, middle)
        end[border] = np.where(first[border], middle, 1.0)
        return np.stack([begin, end])
