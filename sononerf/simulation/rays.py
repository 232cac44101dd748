# SPDX-License-Identifier: MIT
"""Kirchhoff's integral: the first bounce over points of the surface, later ones by rays."""

from __future__ import annotations

import math
from collections.abc import Iterator
from typing import Any

import numpy as np
from numpy.typing import NDArray

from sononerf.geometry.directions import CapSpiral
from sononerf.geometry.meshes import bodies, enclosing_balls
from sononerf.geometry.raycast import RayCaster
from sononerf.numerics import Bools, Floats, Ints, Singles
from sononerf.scene.scene import Scene
from sononerf.simulation.diffraction import EDGE_STEP, Diffraction, Outlines
from sononerf.simulation.hearing import (
    EARS_APART,
    RESOLVED_FREQUENCY,
    Audibility,
    Hearing,
    Listener,
)
from sononerf.simulation.mirror_paths import MirrorPoints, MirrorSearch
from sononerf.simulation.paths import (
    Bounce,
    Reflection,
    aim,
    coarse_gain,
    echo_paths,
    gathered,
    reflection,
    unfaded,
)
from sononerf.simulation.shadows import Shadow, passing
from sononerf.simulation.surface_points import SurfacePoints

DIVIDED_SHARE = 0.6  # fraction of the rays that is kept where a few would be noise
MAX_BEND = 0.3  # rad; a cell over which the path bends by less is fine enough
SILENT_EXPONENT = 7.0  # e to the minus this is -61 dB
ENCLOSING_BALLS = (
    32  # number of balls that enclose the scene; rays that miss all of them are not traced
)


class Rays:
    r"""Echoes by geometrical acoustics and Kirchhoff's integral.

    What arrives at the surface first is summed over points of it, the same for all poses,
    :class:`SurfacePoints`. What bounces on is followed by rays, which fill the cap under which the
    emitter sees the scene, each standing for the same solid angle :math:`d\Omega`. Every point that
    is hit is heard by every ear that sees it, with the pressure

    .. math:: \frac{j f}{c}\, \frac{\sqrt{d\Omega\, dA}}{r_2}\, s\, l\,
        e^{-j k (r_1 + r_2)}\, 10^{-\alpha (r_1 + r_2) / 20}\, B\, E \prod q

    where :math:`dA` is the cross-section of the ray's bundle at the hit (:math:`r_1^2 d\Omega`
    the first time; ray differentials carry it over the bounces), :math:`r_1` the path from the
    emitter to the hit, :math:`r_2` from there to the ear, :math:`s, q` the material's strength and
    the part kept at earlier bounces, :math:`l` its lobe, or of a smooth surface the fade about the
    mirror point (:meth:`Reflection.heard`), :math:`\alpha` the air's absorption, :math:`B, E` the
    gains of beam and ear.

    It is Kirchhoff's integral over what is lit,
    :math:`(j k / 2 \pi) \int p\, \cos\vartheta\, e^{-j k r_2} / r_2\, dS`, with the pressure
    :math:`p` that geometrical acoustics brings there, :math:`\sqrt{d\Omega / dA}`, and
    :math:`dA = \cos\vartheta\, dS`: so the level is absolute and does not depend on the number
    of rays, a plate answers as :math:`1/2h` and a sphere as :math:`a / 2 r^2`. Phase shifts at
    foci of hollow surfaces are left out, but for those after the last bounce.

    Of the first bounce points are lit, and heard, past obstacles as the Fresnel zone says: each of
    the two ways has a factor, :class:`Shadow`. Shadows of later bounces are sharp.

    In: band (K,).
    """

    def __init__(
        self, scene: Scene, hearing: Hearing, *, rays: int, bounces: int, band: Floats | None = None
    ) -> None:
        self.scene, self.hearing = scene, hearing
        self.reflections: tuple[Reflection, ...] = tuple(
            reflection(material, hearing.synthesis.nodes, speed_of_sound=hearing.speed_of_sound)
            for material in scene.materials
        )
        self._caster: RayCaster | None = None
        self._rays = rays
        self.bounces = bounces
        vertices = np.asarray(scene.mesh.vertices, dtype=np.float64)
        self._centre = (vertices.min(axis=0) + vertices.max(axis=0)) / 2.0
        self._radius = float(np.linalg.norm(vertices - self._centre, axis=1).max())
        corners = vertices[np.asarray(scene.mesh.faces)]
        self._body = bodies(scene.mesh)
        self._balls = enclosing_balls(corners, self._body, ENCLOSING_BALLS)
        self._farthest = max(
            math.inf if of_part.material.lobe_width else SILENT_EXPONENT / float(of_part.fade.min())
            for of_part in self.reflections
        )
        turns_per_metre = 2.0 * math.pi * RESOLVED_FREQUENCY / hearing.speed_of_sound
        self._audibility = Audibility(turns_per_metre, self._farthest, self._radius, bounces)
        synthesis = hearing.synthesis
        _, gain = unfaded(synthesis.frequency, speed_of_sound=hearing.speed_of_sound)
        self._smooth = np.array([r.material.lobe_width is None for r in self.reflections])
        any_smooth = bool(self._smooth.any())
        self._hats = synthesis.hats if band is None else synthesis.hats * band[:, None]
        factor = gain if any_smooth else 1j * synthesis.frequency
        self._basis = self._hats * factor[:, None]
        # The part that a shadow turns in phase is imaginary, so it is an odd function of frequency.
        odd_hats = synthesis.odd_hats if band is None else synthesis.odd_hats * band[:, None]
        self._odd_hats = odd_hats * 1j
        self._quadrature_basis = odd_hats * (1j * factor)[:, None]
        # Rough surfaces use the filters of smooth ones, without their compensation of the fade.
        _, gain = unfaded(synthesis.nodes, speed_of_sound=hearing.speed_of_sound)
        self._filtered = np.abs(gain) if any_smooth else synthesis.nodes
        self._lobed_level = synthesis.nodes / self._filtered
        wavenumber = 2.0 * math.pi / hearing.speed_of_sound * synthesis.nodes
        self._wavenumber = wavenumber.astype(np.float32)
        self._reach = max(of_part.reach for of_part in self.reflections)
        self._diffracts = any(reflection.diffraction.any() for reflection in self.reflections)
        self._diffraction: Diffraction | None = None
        self._outlines: Outlines | None = None
        self._points: SurfacePoints | None = None
        self._of_image: Rays | None = None
        if hearing.head.plane is not None and hearing.image is None:
            self._of_image = Rays(scene, hearing.from_image, rays=rays, bounces=bounces, band=band)

    @property
    def rays(self) -> int:
        """Number of rays per pose; as many again start from the emitter's image."""
        return self._rays

    @rays.setter
    def rays(self, count: int) -> None:
        self._rays = count
        if self._of_image is not None:
            self._of_image.rays = count

    @property
    def caster(self) -> RayCaster:
        """The scene's ray caster, built when it is first needed."""
        if self._caster is None:
            self._caster = RayCaster(self.scene.mesh)
        return self._caster

    @property
    def outlines(self) -> Outlines:
        """Edges of the scene that may throw shadows."""
        if self._outlines is None:
            self._outlines = Outlines(self.scene.mesh)
        return self._outlines

    @property
    def points(self) -> SurfacePoints:
        """Points at which the first bounce is summed."""
        if self._points is None:
            self._points = SurfacePoints(
                self.scene.mesh,
                self.caster,
                self.outlines.closed,
                wavelength=self.hearing.speed_of_sound / RESOLVED_FREQUENCY,
            )
        return self._points

    def echo(self, position: Floats, rotation: Floats, *, seed: int) -> Floats:
        """Return the pressure at the ears (E, S) for a call that is one sample of height 1.

        In: position ((3,), m), rotation (3, 3).
        """
        echo = self._echo(position, rotation, seed=seed)
        if self._of_image is not None:
            echo += self._of_image.echo(position, rotation, seed=seed)
        return echo

    def _echo(self, position: Floats, rotation: Floats, *, seed: int) -> Floats:
        first, second = np.random.default_rng(seed).random(2)
        sound, quadrature = self.hearing.silence(), self.hearing.silence()
        shadows = self._shadows(position, rotation)
        bounce = self._first(position, rotation)
        self._hear(sound, quadrature, bounce, position, rotation, shadows=shadows)
        search = self._search(position, rotation)
        later = list(self._paths(position, rotation, (first, second), search.sharpest))
        for bounce in gathered(later):
            self._hear(sound, quadrature, bounce, position, rotation, sharpest=search.sharpest)
        mirrors, turned = self.hearing.silence(), self.hearing.silence()
        self._hear_mirrors(mirrors, turned, search, later, position, rotation)
        echo = self.hearing.echo(sound, self._basis)
        if quadrature.heard:
            echo += self.hearing.echo(quadrature, self._quadrature_basis)
        if mirrors.heard:
            echo += self.hearing.echo(mirrors, self._hats)
        if turned.heard:
            echo += self.hearing.echo(turned, self._odd_hats)
        if self._diffracts:
            if self._diffraction is None:
                step = EDGE_STEP * self.hearing.speed_of_sound / RESOLVED_FREQUENCY
                self._diffraction = Diffraction(
                    self.scene, self.caster, self.reflections, step=step
                )
            edges = self._diffraction.sound(self.hearing, position, rotation)
            echo += self.hearing.echo(edges, self._hats)
        return echo

    def later(self, sound: Listener, position: Floats, rotation: Floats, *, seed: int) -> None:
        """Pass the echoes of the first bounce to a listener; edges are left out."""
        first, second = np.random.default_rng(seed).random(2)
        search = self._search(position, rotation)
        later = list(self._paths(position, rotation, (first, second), search.sharpest))
        for bounce in gathered(later):
            self._hear(sound, sound, bounce, position, rotation, sharpest=search.sharpest)
        scale = 1.0 / self._filtered
        self._hear_mirrors(sound, sound, search, later, position, rotation, scale=scale)
        if self._of_image is not None:
            self._of_image.later(sound, position, rotation, seed=seed)

    def __getstate__(self) -> dict[str, Any]:
        # Search trees cannot be pickled; who receives the mesh builds them anew.
        built = ("_caster", "_diffraction", "_outlines", "_points")
        return {**self.__dict__, **dict.fromkeys(built)}

    def _shadows(self, position: Floats, rotation: Floats) -> list[Shadow]:
        """Shadows of the emitter and of each ear."""
        emitter, ears = self.hearing.places(position, rotation)
        return [
            Shadow(
                self.outlines,
                self.caster,
                place,
                wavenumber=self._wavenumber.astype(np.float64),
                speed_of_sound=self.hearing.speed_of_sound,
                size=self._radius,
            )
            for place in (emitter, *ears)
        ]

    def hits(self, position: Floats, rotation: Floats) -> tuple[Floats, Floats]:
        """Return places that send sound straight back (N, 3), m, and their strength (N,)."""
        bounce = self._first(position, rotation)
        bounce = bounce[np.flatnonzero(self._lit(bounce, position, rotation))]
        total = np.zeros(len(bounce.ray))
        level = self._level(bounce) * self.hearing.beam(bounce.emitted, rotation)
        for place in self.hearing.places(position, rotation)[1]:
            heard, gain, _, _ = self._heard(bounce, place)
            total[heard] += np.square(gain * level[heard]).mean(axis=1)
        # Cells are of different sizes.
        return bounce.points, np.sqrt(total) / bounce.solid_angle

    def _first(self, position: Floats, rotation: Floats) -> Bounce:
        return self.points.lit_from(self.hearing.places(position, rotation)[0])

    def _lit(self, bounce: Bounce, position: Floats, rotation: Floats) -> Bools:
        """Return the mask (H,) of first hits that the emitter sees."""
        emitter, _ = self.hearing.places(position, rotation)
        return self.caster.visible(bounce.points, emitter, normals=bounce.flat)

    def _paths(
        self, position: Floats, rotation: Floats, offset: tuple[float, float], sharpest: float
    ) -> Iterator[Bounce]:
        if self.bounces < 2:
            return iter(())
        emitter, _ = self.hearing.places(position, rotation)
        axis, half_angle = aim(emitter, self._centre, self._radius)
        extra = round(self.rays * DIVIDED_SHARE)
        # Laid out in the head's frame, the pattern turns with head and scene together.
        cap = CapSpiral(self.rays - extra, axis @ rotation, half_angle, offset, rotation)

        listeners = self._listeners(position, rotation)

        def judge(bounce: Bounce) -> tuple[Bools, Floats]:
            return self._audibility.judge(bounce, listeners, sharpest)

        index = self._reaching(cap, emitter)
        return echo_paths(
            self.caster, emitter, cap, bounces=self.bounces, extra=extra, judge=judge, index=index
        )

    def _reaching(self, cap: CapSpiral, emitter: Floats) -> Ints:
        """Return the indices of the rays of a cap that may hit the scene."""
        centres, radii = self._balls
        offsets = centres - emitter
        distance = np.linalg.norm(offsets, axis=1)
        # The caster's single precision is far finer than this margin.
        sine = radii * 1.001 / np.maximum(distance, 1e-300)
        half_angle = np.where(sine < 1.0, np.arcsin(np.minimum(sine, 1.0)), math.pi)
        return cap.reaching(offsets / np.maximum(distance, 1e-300)[:, None], half_angle)

    def _listeners(self, position: Floats, rotation: Floats) -> Floats:
        """Return places (L, 3) that together stand for all ears, m, world frame."""
        _, ears = self.hearing.places(position, rotation)
        if np.ptp(ears, axis=0).max() < EARS_APART:
            return np.asarray(ears.mean(axis=0, keepdims=True))
        # One place stands for all ears within a ball of that size.
        chosen: list[Floats] = []
        for ear in ears:
            if all(np.linalg.norm(ear - other) >= EARS_APART / 2.0 for other in chosen):
                chosen.append(ear)
        return np.stack(chosen)

    def _hear(
        self,
        sound: Listener,
        quadrature: Listener,
        bounce: Bounce,
        position: Floats,
        rotation: Floats,
        *,
        shadows: list[Shadow] | None = None,
        sharpest: float = math.inf,
    ) -> None:
        """Pass what the ears hear of a bounce on; paths sharper than ``sharpest`` are left out."""
        heard_by = []
        is_lit = self._lit(bounce, position, rotation) if shadows else None
        for ear, place in enumerate(self.hearing.places(position, rotation)[1]):
            dim = (shadows[0], shadows[1 + ear]) if shadows else ()
            heard_by.append(self._heard(bounce, place, sharpest, is_lit, *dim))
        anyone = np.zeros(len(bounce.ray), dtype=bool)
        for heard, _, _, _ in heard_by:
            anyone[heard] = True
        chosen = np.flatnonzero(anyone)
        level = self.hearing.beam(bounce.emitted.take(chosen, axis=0), rotation)
        level *= self._level(bounce).take(chosen, axis=0)
        place_of = np.cumsum(anyone) - 1
        for ear, (heard, gain, spread, shaded) in enumerate(heard_by):
            gain *= level.take(place_of.take(heard), axis=0)
            self.hearing.add(
                sound,
                ear,
                bounce.points.take(heard, axis=0),
                length=bounce.length.take(heard),
                spread=spread,
                level=gain,
                position=position,
                rotation=rotation,
                shaded=None if shaded is None else (quadrature, *shaded),
            )

    def _hear_mirrors(
        self,
        sound: Listener,
        turned: Listener,
        search: MirrorSearch,
        later: list[Bounce],
        position: Floats,
        rotation: Floats,
        *,
        scale: Floats | float = 1.0,
    ) -> None:
        """Pass the echoes of mirror paths over several bounces, times ``scale`` (F,), on.

        The part that is turned in phase goes to ``turned``.
        """
        ears = self.hearing.places(position, rotation)[1]
        listeners = self._listeners(position, rotation)
        nearest = np.linalg.norm(ears[:, None] - listeners, axis=2).argmin(axis=1)
        for number, (starts, which) in search.starts(later, listeners, self._body).items():
            middle = search.both_ways(number, starts, listeners, which)
            if middle is None:
                continue
            path, ear = np.nonzero(middle.which[:, None] == nearest)
            mirrors = search.refine(number, middle.bounce.emitted[path], ears, ear)
            if mirrors is not None:
                for one in np.unique(mirrors.which):
                    self._hear_mirror_points(
                        mirrors[mirrors.which == one], position, rotation, (sound, turned, scale)
                    )

    def _hear_mirror_points(
        self,
        mirrors: MirrorPoints,
        position: Floats,
        rotation: Floats,
        echoes: tuple[Listener, Listener, Floats | float],
    ) -> None:
        (sound, turned, scale), bounce = echoes, mirrors.bounce
        ear = int(mirrors.which[0])
        place = self.hearing.places(position, rotation)[1][ear]
        seen = self.caster.visible(bounce.points, place, normals=bounce.flat)
        seen &= np.einsum("nd,nd->n", place - bounce.points, bounce.flat) > 0.0
        bounce = bounce[np.flatnonzero(seen)]
        amplitude = self.hearing.speed_of_sound / mirrors.root[seen] / bounce.solid_angle
        level = self.hearing.beam(bounce.emitted, rotation) * self._level(bounce)
        level *= self._strength(bounce.triangles[:, -1]) * amplitude[:, None] * scale
        phase = np.array([1.0, 1j, -1.0], np.complex64)[mirrors.negative[seen]]
        self.hearing.add(
            sound,
            ear,
            bounce.points,
            length=bounce.length + mirrors.longer[seen],
            spread=np.zeros(len(phase)),
            level=level,
            position=position,
            rotation=rotation,
            shaded=(turned, np.arange(len(phase)), phase[:, None]),
        )

    def _strength(self, triangle: Ints) -> Floats:
        """Strength (N, F) of triangles (N,) towards the mirror direction."""
        part, curvature = self._part(triangle), self.caster.curvature[triangle]
        strength = np.zeros((len(triangle), len(self.hearing.synthesis.nodes)))
        for index, of_surface in enumerate(self.reflections):
            chosen = part == index
            strength[chosen] = of_surface.strength_at(curvature[chosen])
        return strength

    def _search(self, position: Floats, rotation: Floats) -> MirrorSearch:
        emitter, _ = self.hearing.places(position, rotation)
        _, half_angle = aim(emitter, self._centre, self._radius)
        return MirrorSearch(
            self.caster,
            emitter,
            wavenumber=self._audibility.wavenumber,
            cap=4.0 * math.pi * math.sin(half_angle / 2.0) ** 2,
            rays=self.rays - round(self.rays * DIVIDED_SHARE),  # the others divide these
        )

    def _heard(
        self,
        bounce: Bounce,
        ear: Floats,
        sharpest: float = math.inf,
        is_lit: Bools | None = None,
        lit: Shadow | None = None,
        shadow: Shadow | None = None,
    ) -> tuple[Ints, NDArray[np.floating[Any]], Singles, tuple[Ints, NDArray[np.complex64]] | None]:
        """Return the hits (N,) of an ear, their gain (N, F), and the spread of their paths (N,), m.

        The last two are the shaded hits (M,) and the transmitted fraction (M, F), or None.
        """
        paths = bounce.paths_to(ear)
        heard = (paths.rise > 0.0) & (paths.detour < self._farthest)
        heard &= paths.softness <= sharpest
        if self._reach < math.pi:
            heard &= paths.cosine > math.cos(self._reach)
        near = np.flatnonzero(heard)
        seen = self.caster.visible(
            bounce.points.take(near, axis=0), ear, normals=bounce.flat.take(near, axis=0)
        )
        seen, shaded = self._shaded(bounce, near, seen, is_lit, lit, shadow)
        near = near[np.flatnonzero(seen)]
        triangle = bounce.triangles[near, -1]
        gain = self._gain(triangle, paths.cosine.take(near), paths.detour.take(near))
        bend = (paths.stiffness * np.asarray(bounce.solid_angle, dtype=np.float32)).take(near)
        coarse = bend * self._wavenumber[-1] > MAX_BEND
        coarse = np.flatnonzero(coarse & self._smooth[self._part(triangle)])
        gain[coarse] *= coarse_gain(np.multiply.outer(bend.take(coarse), self._wavenumber))
        return near, gain, paths.spread.take(near), shaded

    def _shaded(
        self,
        bounce: Bounce,
        near: Ints,
        seen: Bools,
        is_lit: Bools | None,
        lit: Shadow | None,
        shadow: Shadow | None,
    ) -> tuple[Bools, tuple[Ints, NDArray[np.complex64]] | None]:
        """Return the mask of hits that pass obstacles, and the transmission near an outline."""
        if is_lit is None or lit is None or shadow is None:
            return seen, None
        points, triangle = bounce.points.take(near, axis=0), bounce.triangles[near, -1]
        first, second = lit.passed(points, triangle), shadow.passed(points, triangle)
        passes, dim, passed = passing(*first, is_lit.take(near), *second, seen)
        return passes, (dim, passed) if len(dim) else None

    def _level(self, bounce: Bounce) -> Floats:
        """Level without lobe and beam, (H, 1) or (H, F) m."""
        level = (bounce.solid_angle * np.sqrt(bounce.footprint.tube))[:, None]
        for earlier in bounce.triangles[:, :-1].T:
            kept = np.stack([reflection.kept for reflection in self.reflections])
            if (kept < 1.0).any():
                level = level * kept[self._part(earlier)]
        return level

    def _gain(self, triangle: Ints, cosine: Floats, detour: Singles) -> NDArray[np.floating[Any]]:
        """Lobe times strength of hits towards a listener (N, F)."""
        curvature = self.caster.curvature[triangle]
        if len(self.reflections) == 1:
            return self.reflections[0].heard(cosine, detour, curvature)
        part = self._part(triangle)
        gain = np.zeros((len(triangle), len(self.hearing.synthesis.nodes)), dtype=np.float32)
        for index, of_surface in enumerate(self.reflections):
            of_part = part == index
            found = of_surface.heard(cosine[of_part], detour[of_part], curvature[of_part])
            gain[of_part] = found if self._smooth[index] else found * self._lobed_level
        return gain

    def _part(self, triangle: Ints) -> Ints:
        part = self.scene.part
        return np.zeros(len(triangle), dtype=np.int64) if part is None else part[triangle]
