# SPDX-License-Identifier: MIT
"""Sound bent by edges and outlines: rigid wedges, and outlines seen against the background."""

from __future__ import annotations

import math
from dataclasses import dataclass
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


def diffracting_edges(mesh: trimesh.Trimesh) -> Edges:
    """Return the edges of a mesh that are sharper than a crease, and convex or open."""
    vertices = np.asarray(mesh.vertices, dtype=np.float64)
    # A triangle without area, however its corners lie, has no side to diffract on.
    kept = np.flatnonzero(~_thin(vertices[np.asarray(mesh.faces)]))
    if len(kept) < len(mesh.faces):
        mesh = trimesh.Trimesh(vertices, np.asarray(mesh.faces)[kept], process=False)
    normals = np.asarray(mesh.face_normals, dtype=np.float64)
    angles = np.asarray(mesh.face_adjacency_angles)
    sharp = np.flatnonzero((angles >= CREASE) & np.asarray(mesh.face_adjacency_convex))
    pairs = np.asarray(mesh.face_adjacency)[sharp]
    used = np.asarray(mesh.edges_sorted)
    _, first, count = np.unique(used, axis=0, return_index=True, return_counts=True)
    rim = first[count == 1]
    ends = np.concatenate(
        [vertices[np.asarray(mesh.face_adjacency_edges)[sharp]], vertices[used[rim]]]
    )
    triangle = np.concatenate([pairs[:, 0], np.asarray(mesh.edges_face)[rim]]).astype(np.int64)
    along = ends[:, 1] - ends[:, 0]
    along /= np.linalg.norm(along, axis=1, keepdims=True)
    middle = vertices[np.asarray(mesh.faces)[triangle]].mean(axis=1)
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
        kept[triangle],
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


class Diffraction:
    r"""Points on edges and strongly curved places; each stands for the same fraction of them.

    The measure is the turn of the surface: for an edge its length times the angle between
    its faces' normals, for a curved place :math:`\int s \kappa\, dA`, with the share :math:`s` at
    which its curvature :math:`\kappa` counts as strong. So the level depends neither on the number
    of points nor on that of triangles. A part :math:`dM` (m) of this adds the pressure

    .. math:: D\, \frac{dM}{2 \pi\, r_1 r_2}\, e^{-j k (r_1 + r_2)}\, B\, E

    where emitter and ear both see it, with the material's strength :math:`D`; on an edge
    :math:`dM` is the length alone and :math:`D` is multiplied by the directivity of a rigid wedge.
    """

    def __init__(
        self, scene: Scene, caster: RayCaster, reflections: tuple[Reflection, ...]
    ) -> None:
        self._caster = caster
        self._edges = diffracting_edges(scene.mesh)
        self._corners = np.asarray(scene.mesh.triangles, dtype=np.float64)
        part = np.zeros(len(self._corners), dtype=np.int64) if scene.part is None else scene.part
        self._part = np.concatenate([part[self._edges.triangle], part])
        self._strength = np.stack([reflection.diffraction for reflection in reflections])
        self._fade = reflections[0].fade  # the same for all materials
        share = np.zeros(len(part))
        for index, reflection in enumerate(reflections):
            of_part = part == index
            share[of_part] = reflection.curved_share(caster.curvature[of_part])
        curved = share * caster.curvature * np.asarray(scene.mesh.area_faces, dtype=np.float64)
        turn = self._edges.open_angle - math.pi
        measure = np.concatenate([turn * self._edges.length, curved])
        silent = np.array([not strength.any() for strength in self._strength])
        measure[silent[self._part]] = 0.0
        self._end = np.cumsum(measure)

    def sound(
        self, hearing: Hearing, position: Floats, rotation: Floats, *, points: int, offset: float
    ) -> Sound:
        """Return the sound of edges and curved places at the ears of a pose.

        In: position ((3,), m), rotation (3, 3).
        """
        sound = hearing.silence()
        share = self._end[-1] / points
        if share == 0.0:
            return sound
        place, away, along, index = self._places(share, points, offset)
        emitter, ears = hearing.places(position, rotation)
        lit = self._caster.visible(place, emitter, normals=away)
        place, away, along, index = place[lit], away[lit], along[lit], index[lit]
        emitted = place - emitter
        length = np.linalg.norm(emitted, axis=1)
        emitted /= length[:, None]
        level = hearing.beam(emitted, rotation) * self._strength[self._part[index]]
        level *= (share * hearing.speed_of_sound / (2.0 * math.pi) / length)[:, None]
        on_edge = index < len(self._edges.triangle)
        edge = index[on_edge]
        wedge = (
            self._edges.inward[edge], self._edges.normal[edge], self._edges.open_angle[edge],
            emitter - place[on_edge],
        )  # fmt: skip
        turn = self._edges.open_angle[edge] - math.pi
        for ear, listener in enumerate(ears):
            weight = np.ones_like(level)
            weight[on_edge] = wedge_directivity(*wedge, listener - place[on_edge], self._fade)
            weight[on_edge] /= turn[:, None]
            seen = self._caster.visible(place, listener, normals=away)
            towards = listener - place[seen]
            towards /= np.linalg.norm(towards, axis=1, keepdims=True)
            spread = np.abs(np.einsum("nd,nd->n", along[seen], emitted[seen] - towards))
            hearing.add(
                sound,
                ear,
                place[seen],
                length=length[seen],
                spread=spread / math.sqrt(12.0),
                level=level[seen] * weight[seen],
                position=position,
                rotation=rotation,
            )
        return sound

    def _places(
        self, share: float, points: int, offset: float
    ) -> tuple[Floats, Floats, Floats, Ints]:
        """Return points, outward directions, the stretches they stand for (N, 3 each), kinds."""
        at = (np.arange(points) + offset) * share
        index = np.searchsorted(self._end, at, side="right")
        measure = np.diff(self._end, prepend=0.0)[index]
        fraction = 1.0 - (self._end[index] - at) / measure
        on_edge = index < len(self._edges.triangle)
        place, away, along = np.zeros((3, points, 3))
        chosen = index[on_edge]
        start, end = self._edges.ends[chosen, 0], self._edges.ends[chosen, 1]
        place[on_edge] = start + fraction[on_edge, None] * (end - start)
        away[on_edge] = self._edges.away[chosen]
        along[on_edge] = (end - start) * np.minimum(share / measure[on_edge], 1.0)[:, None]
        triangle = index[~on_edge] - len(self._edges.triangle)
        # Uniform over a triangle: Osada et al., "Shape distributions", ACM TOG 21(4), 2002.
        root = np.sqrt(fraction[~on_edge])
        across = np.mod(np.flatnonzero(~on_edge) * GOLDEN_TURN + offset, 1.0)
        weights = np.stack([1.0 - root, root * (1.0 - across), root * across], axis=1)
        place[~on_edge] = np.einsum("nc,ncd->nd", weights, self._corners[triangle])
        away[~on_edge] = self._caster.face_normals[triangle]
        return place, away, along, index
