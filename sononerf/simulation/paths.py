# SPDX-License-Identifier: MIT
"""Paths of rays: mirror points, the lobe around them, and the remainder that goes on."""

from __future__ import annotations

import math
import sys
from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from sononerf.geometry.directions import CapSpiral, Cells
from sononerf.geometry.raycast import RayCaster
from sononerf.numerics import Bools, Complexes, Floats, Ints, Singles, compiled
from sononerf.scene.material import Material
from sononerf.simulation.footprint import Footprint, MirrorPaths, emit_bundles, land, onto, paths_to

COARSEST = 10.0  # rad
LEAST_RISE = 1e-4  # sine of the angle below which sound grazes a surface
# Beyond this many standard deviations a lobe is 3e-4 of its middle (-70 dB) and left out.
BEAM_WIDTHS = 4.0
# A smooth surface sends sound where its shape does: Kirchhoff's integral over it, which lives from
# the first Fresnel zones about the mirror point. Places farther away fade by this much per radian
# of phase; by itself it would cancel, up to false echoes from the border of light and shadow and
# the noise of rays that are too few for it.
FADE = 1.0
# Well below this the fade is no slower, so that places far from the mirror point need not be
# followed.
FADE_FREQUENCY = 25e3  # Hz


@dataclass(frozen=True, eq=False)
class Reflection:
    """A material at the frequencies of a simulation."""

    fade: Floats  # (F,), 1/m: Decay of a smooth surface over the detour from the mirror's path
    lobe_width: Floats  # (F,), rad: Standard deviation of the lobe; of a smooth surface, not used
    strength: Floats  # (F,), 1: Strengths of what is heard of a hit
    kept: Floats  # (F,), 1: Pressure after a bounce, over that before it
    curved_lobe_width: Floats  # (F,): The same where the surface is strongly curved
    curved_strength: Floats
    # (F,), 1: Strength of edges and strongly curved places as sources of their own
    diffraction: Floats
    material: Material  # Material of these values

    def curved_share(self, curvature: Floats) -> Floats:
        """Return the curvature of places, 0 to 1, from their total curvature (N,) in 1/m."""
        steepness = 8.0 * self.material.transition_slope
        away = steepness * (curvature - self.material.transition_curvature)
        return 0.5 * (1.0 + np.tanh(0.5 * away))

    def heard(
        self, cosine: Floats, detour: NDArray[np.floating[Any]], curvature: Floats
    ) -> NDArray[np.floating[Any]]:
        r"""Lobe times strength.

        The echo of a smooth surface fades by :math:`e^{-\epsilon k \delta}` with the detour
        :math:`\delta`; :func:`unfaded` compensates the loss.

        In: cosine (N,), detour ((N,), m), curvature ((N,), 1/m). Out: gain (N, F).
        """
        strength = self.strength_at(curvature)
        share = self.curved_share(curvature)[:, None] if self.material.mixed else None
        gain: NDArray[np.floating[Any]]
        if self.material.lobe_width is None:
            gain = np.exp(np.multiply.outer(detour, -self.fade.astype(np.float32)))
        else:
            width = self.lobe_width
            if share is not None:
                width = width + share * (self.curved_lobe_width - width)
            gain = np.exp(lobe_exponent(cosine, width))
        gain *= strength
        return gain

    def strength_at(self, curvature: Floats) -> Floats:
        """Return the strength (F,) or (N, F) of places of a total curvature (N,), 1/m."""
        if not self.material.mixed:
            return self.strength
        share = self.curved_share(curvature)[:, None]
        return self.strength + share * (self.curved_strength - self.strength)

    @property
    def reach(self) -> float:
        """Angle off the mirror direction beyond which nothing is heard, rad."""
        if self.material.lobe_width is None:
            return math.pi
        widest = float(self.lobe_width.max())
        if self.material.mixed:
            widest = max(widest, float(self.curved_lobe_width.max()))
        return min(BEAM_WIDTHS * widest, float(np.pi))


def reflection(material: Material, frequency: ArrayLike, *, speed_of_sound: float) -> Reflection:
    """Return a material's values at frequencies (F,) in Hz, straight over their logarithm."""
    log_frequency, nodes = np.log(np.asarray(frequency)), np.log(material.frequency)

    def at(*curves: tuple[float, ...] | None) -> Floats:
        given = next((curve for curve in curves if curve is not None), (0.0,) * len(nodes))
        return np.interp(log_frequency, nodes, given)

    fade, _ = unfaded(np.asarray(frequency, dtype=np.float64), speed_of_sound=speed_of_sound)
    return Reflection(
        fade,
        at(material.lobe_width),
        at(material.strength),
        at(material.reflection),
        at(material.curved_lobe_width, material.lobe_width),
        at(material.curved_strength, material.strength),
        at(material.diffraction),
        material,
    )


def unfaded(frequency: Floats, *, speed_of_sound: float) -> tuple[Floats, Complexes]:
    r"""Return the fade of smooth surfaces, and the gain that compensates it.

    Faded, Kirchhoff's integral over the Fresnel zones is
    :math:`\int e^{-(\epsilon + j) k \delta} d\delta = 1 / (\epsilon + j) k` in place of
    :math:`1 / j k`, at all curvatures; the factor :math:`1 - j \epsilon` is the same everywhere.

    In: frequency ((F,), Hz), speed_of_sound (m/s). Out: fade ((F,), 1/m), gain ((F,) complex128,
    Hz).
    """
    faded = FADE * np.hypot(frequency, FADE_FREQUENCY)
    gain = (1j * frequency + faded).astype(np.complex128)
    return 2.0 * math.pi / speed_of_sound * faded, gain


def coarse_gain(bend: Singles) -> Singles:
    r"""Return the gain that compensates the mean loss of a smooth surface by coarse cells.

    A cell is laid into time bins as wide as its paths are spread, by the slope of the path over it
    and by its bend :math:`b = k \lambda \Omega`, :math:`\lambda` the Hessian's eigenvalue. Over
    all places of a mirror point among the cells the slope's spread acts as a further fade by
    :math:`b / 12`, and the bend's as a loss of :math:`e^{-b^2 / 720}`: variances over a square.

    In: bend ((N, F) float32, rad). Out: gain ((N, F) float32).
    """
    b = np.minimum(bend, np.float32(COARSEST))
    fade = np.square(np.float32(FADE) + b / np.float32(12.0)) + np.float32(1.0)
    fade /= np.float32(FADE**2 + 1.0)
    return np.sqrt(fade) * np.exp(np.square(b) / np.float32(720.0))


@compiled
def leave(directions: Floats, flat: Floats, points: Floats, lift: float) -> tuple[Floats, Floats]:
    """Start rays off the surface, turned so far that those which run into it graze it.

    A mirror direction about a smooth normal may point into the flat triangle that was hit.

    In: directions (N, 3), flat (N, 3), points ((N, 3), m), lift (m). Out: origins ((N, 3), m),
    directions (N, 3).
    """
    origins, onward = np.zeros((len(points), 3)), np.zeros((len(points), 3))
    for i in range(len(points)):
        rise = 0.0
        for k in range(3):
            rise += directions[i, k] * flat[i, k]
        more = max(LEAST_RISE - rise, 0.0)
        length = 0.0
        for k in range(3):
            origins[i, k] = points[i, k] + lift * flat[i, k]
            onward[i, k] = directions[i, k] + more * flat[i, k]
            length += onward[i, k] * onward[i, k]
        if more > 0.0:
            length = math.sqrt(length)
            for k in range(3):
                onward[i, k] /= length
    return origins, onward


def lobe_exponent(cosine: Floats, lobe_width: Floats) -> Floats:
    """Logarithm of the lobe, ``-theta**2 / (2 w**2)``.

    In: cosine (N,), lobe_width ((F,) or (N, F), rad). Out: exponent (N, F).
    """
    theta = np.arccos(np.clip(cosine, -1.0, 1.0))
    return -0.5 * np.square(theta)[:, None] / np.square(lobe_width)


SPLIT = 2  # along each side of a divided cell
BATCH_HITS = 8192  # hits processed together: a call of numpy costs as much as hundreds
CHUNK = 49_152  # rays; fewer and calls add up, more and they leave the processor's cache


@dataclass(frozen=True, eq=False)
class Bounce:
    """Rays that hit the surface for the n-th time."""

    number: int  # n, the first hit being 1
    solid_angle: float | Floats  # float or (H,) float64, sr: Solid angle of each ray
    ray: Ints  # (H,): Index of the emitted ray
    emitted: Floats  # (H, 3): Their directions from the emitter
    points: Floats  # (H, 3), m: Hit points
    flat: Floats  # (H, 3): Normals of the triangles, on the side of the ray
    mirrored: Floats  # (H, 3): Mirror directions
    length: Floats  # (H,), m: From the emitter along the path
    footprint: Footprint  # Footprint of the bundles
    triangles: Ints  # (H, n): Indices of the triangles hit so far, this one last

    def paths_to(self, listener: Floats) -> MirrorPaths:
        """Compare the ways of all hits to a listener (3,), m, with those of a mirror."""
        angle = np.atleast_1d(np.asarray(self.solid_angle, dtype=np.float64))
        rows = self.footprint.rows
        distance, cosine, found = paths_to(
            rows, self.points, self.flat, self.mirrored, listener, angle
        )
        return MirrorPaths(distance, cosine, *found)

    def __getitem__(self, chosen: Ints) -> Bounce:
        """Return the chosen hits."""
        return Bounce(
            self.number,
            angle if isinstance(angle := self.solid_angle, float) else angle.take(chosen),
            self.ray.take(chosen),
            self.emitted.take(chosen, axis=0),
            self.points.take(chosen, axis=0),
            self.flat.take(chosen, axis=0),
            self.mirrored.take(chosen, axis=0),
            self.length.take(chosen),
            Footprint(self.footprint.rows.take(chosen, axis=0)),
            self.triangles.take(chosen, axis=0),
        )


def gathered(bounces: Iterable[Bounce]) -> Iterator[Bounce]:
    """Yield the same hits in fewer parts; none of them is empty.

    Indices of rays are no longer valid afterwards.
    """
    waiting: dict[int, list[Bounce]] = {}
    for bounce in bounces:
        if len(bounce.ray) == 0:
            continue
        alike = waiting.setdefault(bounce.number, [])
        alike.append(bounce)
        if sum(len(part.ray) for part in alike) >= BATCH_HITS:
            yield joined(alike)
            alike.clear()
    for alike in waiting.values():
        if alike:
            yield joined(alike)


def joined(bounces: list[Bounce]) -> Bounce:
    """Return the hits of bounces of one number as one; their rays keep their indices."""
    if len(bounces) == 1:
        return bounces[0]

    def of_hits(name: str) -> NDArray[Any]:
        return np.concatenate([getattr(bounce, name) for bounce in bounces])

    angles = [np.broadcast_to(bounce.solid_angle, len(bounce.ray)) for bounce in bounces]
    names = ("ray", "emitted", "points", "flat", "mirrored", "length", "triangles")
    joined: dict[str, Any] = {name: of_hits(name) for name in names}
    footprint = Footprint(np.concatenate([bounce.footprint.rows for bounce in bounces]))
    return replace(bounces[0], solid_angle=np.concatenate(angles), footprint=footprint, **joined)


def aim(emitter: Floats, centre: Floats, radius: float) -> tuple[Floats, float]:
    """Axis and half angle of the cap under which a point sees a ball.

    In: emitter, centre ((3,), m), radius (m). Out: axis ((3,), m), half_angle (rad).
    """
    axis = centre - emitter
    distance = float(np.linalg.norm(axis))
    if distance <= radius:
        return np.array([1.0, 0.0, 0.0]), math.pi
    return axis, math.asin(radius / distance)


def trace(
    caster: RayCaster, emitter: Floats, directions: Floats, bounces: int, *, solid_angle: float
) -> Iterator[Bounce]:
    """Follow rays over mirror bounces.

    Both sides of a surface are alike: the side that a ray hits is the outside.

    In: emitter ((3,), m), directions (N, 3), solid_angle (sr).
    """
    origins = np.broadcast_to(emitter, directions.shape)
    hits = caster.first_hit(origins, directions)
    length = hits.distance
    ray, emitted = hits.ray, directions.take(hits.ray, axis=0)
    incoming, bundles = emitted, emit_bundles(emitted, length)
    triangles = hits.triangle[:, None]
    for number in range(1, bounces + 1):
        if len(ray) == 0:
            return
        rows, tilts, flat, mirrored = land(
            bundles, incoming, hits.normals, hits.flat, hits.gradients
        )
        yield Bounce(
            number, solid_angle, ray, emitted, hits.points, flat, mirrored, length,
            Footprint(rows), triangles,
        )  # fmt: skip
        if number == bounces:
            return
        origins, onward = leave(mirrored, flat, hits.points, caster.lift)
        hits = caster.first_hit(origins, onward)
        further = hits.ray
        incoming = onward.take(further, axis=0)
        bundles = onto(rows, tilts, further, hits.distance)
        ray, emitted = ray.take(further), emitted.take(further, axis=0)
        length = length.take(further) + hits.distance
        triangles = np.concatenate(
            [triangles.take(further, axis=0), hits.triangle[:, None]], axis=1
        )


def echo_paths(
    caster: RayCaster,
    emitter: Floats,
    cap: CapSpiral,
    *,
    bounces: int,
    extra: int,
    judge: Callable[[Bounce], tuple[Bools, Floats]],
    index: Ints | None = None,
) -> Iterator[Bounce]:
    """Follow the rays of a cap over later bounces, with more where a few would give noise.

    A curved surface spreads neighbouring rays tenfold and more at each bounce, so a pattern that
    is dense at the first hit is sparse at the second. The cells of doubtful rays are divided
    repeatedly, until no ray is doubtful or the extra rays are used up. This is stratified sampling,
    refined where the integrand is not resolved.

    In: emitter ((3,), m), index (N,).
    """
    rays = np.arange(cap.count) if index is None else index
    directions, parts, count = cap.directions(rays), 1, cap.count
    cells: Cells | None = None
    while True:
        weight = np.zeros(count)
        audible_bounces: list[tuple[Bounce, Ints]] = []
        solid_angle = cap.solid_angle / parts
        for start in range(0, len(directions), CHUNK):
            chunk = directions[start : start + CHUNK]
            for bounce in trace(caster, emitter, chunk, bounces, solid_angle=solid_angle):
                if bounce.number == 1:
                    continue
                bounce = replace(bounce, ray=rays.take(bounce.ray + start))
                if extra < SPLIT**2:  # no cell can be divided further
                    audible_bounces.append((bounce, np.arange(len(bounce.ray))))
                    continue
                audible, doubt = judge(bounce)
                # A ray hits once per bounce, so that no ray appears twice.
                weight[bounce.ray] = np.maximum(weight[bounce.ray], doubt)
                if cells is None and bounce.number == 2:
                    # Next to a ray that hits again is one that just missed.
                    around = cap.neighbourhood(bounce.ray)
                    least = max(float(doubt.mean()), sys.float_info.min)
                    weight[around] = np.maximum(weight[around], least)
                audible_bounces.append((bounce, np.flatnonzero(audible)))
        chosen = np.flatnonzero(weight)
        most = extra // SPLIT**2
        if len(chosen) > most:
            chosen = np.sort(chosen[np.argsort(-weight[chosen], kind="stable")[:most]])
        left = np.ones(len(weight), dtype=bool)
        left[chosen] = False
        for bounce, heard in audible_bounces:
            kept = heard[left[bounce.ray.take(heard)]]
            yield bounce if len(kept) == len(bounce.ray) else bounce[kept]
        if len(chosen) == 0:
            return
        cells = (cap.cells(chosen) if cells is None else cells[chosen]).divided(SPLIT)
        directions, parts, count = cap.towards(cells), cells.parts, cells.middles.shape[1]
        rays = np.arange(count)
        extra -= count
