# SPDX-License-Identifier: MIT
"""The slow engine: physical optics, Kirchhoff's integral over all that emitter and ears see."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any

import numpy as np

from sononerf.array_types import Bools, Floats, Ints, Singles
from sononerf.geometry.normals import corner_normals
from sononerf.scene.scene import Scene
from sononerf.simulation.engine import Engine
from sononerf.simulation.hearing import Hearing

CHUNK = 1 << 14  # pieces at a time; more do not fit a processor's cache
BORDER_CUTS = 4  # of pieces that are seen in part: into 16, a quarter as long


@dataclass(frozen=True, eq=False)
class Elements:
    """Small flat pieces of surface, on the side that the emitter sees.

    Attributes:
        points ((N, 3), m): Their middles.
        corners ((N, 3, 3), m): Seen from the middles.
        triangle (N,): Triangle of the mesh.
        area ((N,), m2): Area of each.
        normals (N, 3): Normals of the smooth surface, unit vectors.
        heard (N, E): Whether emitter and ear see them.
    """

    points: Floats
    corners: Floats
    triangle: Ints
    area: Floats
    normals: Floats
    heard: Bools


class Kirchhoff(Engine):
    r"""Echoes by physical optics [1]_.

    The pressure at an ear is

    .. math:: \frac{j k}{4 \pi} \int (\cos\vartheta_1 + \cos\vartheta_2)\,
        \frac{e^{-j k (r_1 + r_2)}}{r_1 r_2}\, 10^{-\alpha (r_1 + r_2) / 20}\, s\, B\, E\, dS

    over the surface that both the emitter and that ear see, with :math:`\vartheta_1, r_1` the
    angle of incidence and the distance of the emitter, :math:`\vartheta_2, r_2` those of the ear,
    :math:`s` the material's strength, :math:`\alpha` the air's absorption, :math:`B, E` the gains
    of beam and ear. Time runs as :math:`e^{j \omega t}`; terms in :math:`1 / k r` are left out.
    Exchanging emitter and ear changes nothing.

    Valid for bodies that are large against the wavelength, ka above 5 for a sphere of radius a.
    There are single echoes only, nothing creeps round a body or into its shadow, and of a
    material only the strength counts. Against the exact series of a sphere the level errs by up
    to 2 dB for ka 5 to 12 (0.7 dB root mean square) and by up to 0.7 dB for ka 12 to 50: the
    sharp border of the light answers with a false echo, some 1 / (2 ka) of the glint.

    Triangles are halved until the way from the emitter over a piece to an ear varies by no more
    than a part of the shortest wavelength, so that surfaces along the sound are cut finely and
    those across it coarsely; at borders of shadows they are cut further. Positions are those of
    the flat triangles, angles those of the smooth surface: a sphere of triangles up to one
    wavelength long is as good as a round one.

    Args:
        frequency_max (Hz): Up to which the echo is right; higher ones fade.
        elements_per_wavelength: Pieces over which the way varies by one wavelength of
            ``frequency_max``; no piece is longer than the wavelength.

    References:
        .. [1] J. J. Bowman, T. B. A. Senior and P. L. E. Uslenghi, "Electromagnetic and Acoustic
           Scattering by Simple Shapes", North-Holland 1969, chapter 1 (physical optics).
    """

    def __init__(
        self,
        scene: Scene,
        hearing: Hearing,
        *,
        frequency_max: float,
        elements_per_wavelength: float = 4.0,
    ) -> None:
        super().__init__(scene, hearing)
        self.wavelength = hearing.speed_of_sound / frequency_max
        self.elements_per_wavelength = elements_per_wavelength
        self._strength = np.stack([reflection.strength for reflection in self.reflections])
        self._corners: Floats | None = None

    def __getstate__(self) -> dict[str, Any]:
        return {**super().__getstate__(), "_corners": None}

    @property
    def corners(self) -> Floats:
        """Positions (m) and smooth normals of the triangles' corners (T, 3, 6)."""
        if self._corners is None:
            mesh = self.scene.mesh
            places = np.asarray(mesh.vertices, dtype=np.float64)[np.asarray(mesh.faces)]
            self._corners = np.concatenate([places, corner_normals(mesh)], axis=2)
        return self._corners

    def echo(
        self,
        position: Floats,
        rotation: Floats,
        *,
        seed: int,  # noqa: ARG002  (nothing is random)
    ) -> Floats:
        """Pressure at both ears; see :meth:`Engine.echo`."""
        emitter, ears = self.hearing.places(position, rotation)
        sound = self.hearing.silence()
        for elements in self._elements(emitter, ears):
            length, away = _away(elements.points, emitter)
            level = self._lit(elements, length, away, rotation) * elements.area[:, None]
            for ear, place in enumerate(ears):
                heard = np.flatnonzero(elements.heard[:, ear])
                _, back = _away(elements.points[heard], place)
                slope = away[heard] + back
                # The variance over a triangle is a twelfth of the sum over its corners.
                path = np.einsum("ncd,nd->nc", elements.corners[heard], slope)
                self.hearing.add(
                    sound,
                    ear,
                    elements.points[heard],
                    length=length[heard],
                    spread=np.sqrt(np.einsum("nc,nc->n", path, path) / 12.0),
                    level=level[heard] * _cosine(elements.normals[heard], away[heard], back),
                    position=position,
                    rotation=rotation,
                )
        return self.hearing.echo(sound)

    def hits(
        self,
        position: Floats,
        rotation: Floats,
        *,
        seed: int,  # noqa: ARG002  (nothing is random)
    ) -> tuple[Floats, Floats]:
        """Places that send sound straight back, and how much; see :meth:`Engine.hits`.

        The patch is one wavelength long: if it is not seen straight on, it extinguishes itself.
        """
        emitter, ears = self.hearing.places(position, rotation)
        points, strength = [np.zeros((0, 3))], [np.zeros(0)]
        for elements in self._elements(emitter, ears):
            length, away = _away(elements.points, emitter)
            level = self._lit(elements, length, away, rotation)
            total = np.zeros(len(length))
            for ear, place in enumerate(ears):
                heard = np.flatnonzero(elements.heard[:, ear])
                distance, back = _away(elements.points[heard], place)
                normals = elements.normals[heard]
                slope = away[heard] + back
                slope -= _dot(slope, normals)[:, None] * normals
                # Of phase over the patch: (2 pi)^2 / 12 of the slope's square.
                variance = np.pi**2 / 3.0 * _dot(slope, slope)
                gain = level[heard] * _cosine(normals, away[heard], back)
                gain *= self.hearing.gain(ear, -back, rotation)
                gain *= (np.exp(-0.5 * variance) / distance)[:, None]
                total[heard] += np.square(gain).mean(axis=1)
            points.append(elements.points)
            strength.append(np.sqrt(total))
        return np.concatenate(points), np.concatenate(strength)

    def _lit(
        self,
        elements: Elements,
        length: Floats,
        away: Floats,
        rotation: Floats,
    ) -> Singles:
        """Sound that arrives, times the material's strength (N, F), 1/m."""
        lit = self.hearing.beam(-away, rotation)
        part = self.scene.part
        lit *= self._strength[0] if part is None else self._strength[part[elements.triangle]]
        lit /= length[:, None]
        return lit

    def _elements(self, emitter: Floats, ears: Floats) -> Iterator[Elements]:
        """Give all that is heard, some at a time."""
        flat = self.caster.face_normals
        first = self.corners[:, 0, :3]
        side = np.sign(_dot(emitter - first, flat))
        facing = side * np.stack([_dot(place - first, flat) for place in ears]) > 0.0  # (E, T)

        def heard(points: Floats, of: Ints) -> Bools:
            normals = flat[of] * side[of, None]
            lit = np.flatnonzero(self.caster.visible(points, emitter, normals=normals))
            found = np.zeros((len(points), len(ears)), dtype=np.bool_)
            for ear, place in enumerate(ears):
                some = lit[facing[ear, of[lit]]]
                found[some, ear] = self.caster.visible(points[some], place, normals=normals[some])
            return found

        for corners, of in self._cut(np.flatnonzero(facing.any(axis=0)), emitter, ears):
            points = corners[:, :, :3].mean(axis=1)
            # Halfway to the corners.
            probes = ((corners[:, :, :3] + points[:, None]) / 2.0).reshape(-1, 3)
            seen = heard(probes, np.repeat(of, 3)).reshape(len(of), 3, -1)
            whole: Bools = np.all(seen, axis=1)
            border = np.any(np.any(seen, axis=1) & ~whole, axis=1)
            kept = np.any(whole, axis=1) & ~border
            yield _elements(corners[kept], of[kept], side, whole[kept])
            if border.any():
                corners, of = corners[border], of[border]
                for _ in range(BORDER_CUTS):
                    corners = _halve(corners, _edges(corners[:, :, :3]).argmax(axis=1))
                of = np.tile(of, 2**BORDER_CUTS)
                found = heard(corners[:, :, :3].mean(axis=1), of)
                kept = found.any(axis=1)
                yield _elements(corners[kept], of[kept], side, found[kept])

    def _cut(self, triangle: Ints, emitter: Floats, ears: Floats) -> Iterator[tuple[Floats, Ints]]:
        """Halve triangles across their worst edge until all are fine, some at a time."""
        for start in range(0, len(triangle), CHUNK):
            some = triangle[start : start + CHUNK]
            waiting = [(self.corners[some], some)]
            while waiting:
                corners, of = waiting.pop()
                if len(of) > CHUNK:
                    waiting.append((corners[CHUNK:], of[CHUNK:]))
                    corners, of = corners[:CHUNK], of[:CHUNK]
                size = self._size(corners[:, :, :3], emitter, ears)
                coarse = size.max(axis=1) > self.wavelength
                if not coarse.all():
                    yield corners[~coarse], of[~coarse]
                if coarse.any():
                    halves = _halve(corners[coarse], size[coarse].argmax(axis=1))
                    waiting.append((halves, np.tile(of[coarse], 2)))

    def _size(self, corners: Floats, emitter: Floats, ears: Floats) -> Floats:
        """Return what must not exceed the wavelength, per edge (N, 3): longer side or path, m."""
        size = _edges(corners)
        out = _away(corners, emitter)[0]
        for place in ears:
            path = out + _away(corners, place)[0]
            change = np.abs(path[:, [1, 2, 0]] - path[:, [2, 0, 1]])
            size = np.maximum(size, self.elements_per_wavelength * change)
        return size


def _elements(
    corners: Floats,
    of: Ints,
    side: Floats,
    heard: Bools,
) -> Elements:
    middle = corners.mean(axis=1)
    around = corners[:, :, :3] - middle[:, None, :3]
    # The middle and two corners make a third of the triangle.
    area = 1.5 * np.linalg.norm(np.cross(around[:, 0], around[:, 1]), axis=1)
    normals = middle[:, 3:] * side[of, None]
    length = np.sqrt(_dot(normals, normals))
    normals /= np.where(length > 0.0, length, 1.0)[:, None]
    return Elements(middle[:, :3], around, of, area, normals, heard)


def _halve(corners: Floats, edge: Ints) -> Floats:
    """Cut triangles (N, 3, D) through the middle of an edge, named by the corner opposite."""
    order = (edge[:, None] + np.arange(3)) % 3
    turned = np.take_along_axis(corners, order[:, :, None], axis=1)
    halves = np.stack([turned, turned])
    halves[0, :, 2] = halves[1, :, 1] = (turned[:, 1] + turned[:, 2]) / 2.0
    return halves.reshape(-1, *corners.shape[1:])


def _edges(corners: Floats) -> Floats:
    """Length of the edges opposite to each corner, (N, 3)."""
    edges = corners[:, [1, 2, 0]] - corners[:, [2, 0, 1]]
    return np.sqrt(_dot(edges, edges))


def _away(points: Floats, place: Floats) -> tuple[Floats, Floats]:
    """Distance (...,) of points from a place, and unit vectors (..., 3) towards it."""
    away = place - points
    distance = np.sqrt(_dot(away, away))
    return distance, away / distance[..., None]


def _cosine(normals: Floats, away: Floats, back: Floats) -> Floats:
    """Mean cosine of both angles (N, 1); nothing comes from below the smooth surface."""
    both = np.maximum(_dot(normals, away), 0.0) + np.maximum(_dot(normals, back), 0.0)
    return both[:, None] / 2.0


def _dot(a: Floats, b: Floats) -> Floats:
    product: Floats = np.einsum("...d,...d->...", a, b)
    return product
