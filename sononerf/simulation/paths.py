# SPDX-License-Identifier: MIT
"""Paths of sound: rays from the emitter, bounce by bounce, each with its footprint."""

from __future__ import annotations

import math
import sys
from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from sononerf.geometry.directions import CapSpiral, Cells
from sononerf.geometry.raycast import Hits, RayCaster
from sononerf.numerics import Bools, Floats, Ints
from sononerf.simulation.footprint import Footprint, Ways, emit, land, onto, ways_to
from sononerf.simulation.reflection import leave

SPLIT = 2  # along each side of a divided cell
GATHERED = 8192  # hits processed together: a call of numpy costs as much as hundreds
CHUNK = 49_152  # rays; fewer and calls add up, more and they leave the processor's cache

Beyond = Callable[[Hits, Floats], tuple[Hits, Floats]]


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
    hidden: bool = False  # Whether the rays went through an obstacle as if it were not there

    def ways_to(self, listener: Floats) -> Ways:
        """Compare the ways of all hits to a listener (3,), m, with those of a mirror."""
        angle = np.atleast_1d(np.asarray(self.solid_angle, dtype=np.float64))
        rows = self.footprint.rows
        distance, cosine, found = ways_to(
            rows, self.points, self.flat, self.mirrored, listener, angle
        )
        return Ways(distance, cosine, *found)

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
            self.hidden,
        )


def gathered(bounces: Iterable[Bounce]) -> Iterator[Bounce]:
    """Yield the same hits in fewer parts; none of them is empty.

    Indices of rays are no longer valid afterwards.
    """
    waiting: dict[tuple[int, bool], list[Bounce]] = {}
    for bounce in bounces:
        if len(bounce.ray) == 0:
            continue
        alike = waiting.setdefault((bounce.number, bounce.hidden), [])
        alike.append(bounce)
        if sum(len(part.ray) for part in alike) >= GATHERED:
            yield _joined(alike)
            alike.clear()
    for alike in waiting.values():
        if alike:
            yield _joined(alike)


def _joined(bounces: list[Bounce]) -> Bounce:
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
    caster: RayCaster,
    emitter: Floats,
    directions: Floats,
    bounces: int,
    *,
    solid_angle: float,
    beyond: Beyond | None = None,
) -> Iterator[Bounce]:
    """Follow rays over mirror bounces.

    Both sides of a surface are alike: the side that a ray hits is the outside.

    In: emitter ((3,), m), directions (N, 3), solid_angle (sr).
    """
    origins = np.broadcast_to(emitter, directions.shape)
    hits = caster.first_hit(origins, directions)
    length = hits.distance
    if beyond is not None:
        hits, length = beyond(hits, directions)
    ray, emitted = hits.ray, directions.take(hits.ray, axis=0)
    incoming, bundles = emitted, emit(emitted, length)
    triangles = hits.triangle[:, None]
    for number in range(1, bounces + 1):
        if len(ray) == 0:
            return
        rows, turned, flat, mirrored = land(
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
        bundles = onto(rows, turned, further, hits.distance)
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
    beyond: Beyond | None = None,
    index: Ints | None = None,
) -> Iterator[Bounce]:
    """Follow the rays of a cap, with more rays where a few would give noise.

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
        bounces_found: list[tuple[Bounce, Ints]] = []
        solid_angle = cap.solid_angle / parts
        for start in range(0, len(directions), CHUNK):
            chunk = directions[start : start + CHUNK]
            for bounce in trace(
                caster, emitter, chunk, bounces, solid_angle=solid_angle, beyond=beyond
            ):
                bounce = replace(bounce, ray=rays.take(bounce.ray + start))
                if extra < SPLIT**2:  # no cell can be divided further
                    bounces_found.append((bounce, np.arange(len(bounce.ray))))
                    continue
                audible, doubt = judge(bounce)
                # A ray hits once per bounce, so that no ray appears twice.
                weight[bounce.ray] = np.maximum(weight[bounce.ray], doubt)
                if cells is None and bounce.number == 2:
                    # Next to a ray that hits again is one that just missed.
                    around = cap.neighbourhood(bounce.ray)
                    least = max(float(doubt.mean()), sys.float_info.min)
                    weight[around] = np.maximum(weight[around], least)
                bounces_found.append((bounce, np.flatnonzero(audible)))
        chosen = np.flatnonzero(weight)
        most = extra // SPLIT**2
        if len(chosen) > most:
            chosen = np.sort(chosen[np.argsort(-weight[chosen], kind="stable")[:most]])
        left = np.ones(len(weight), dtype=bool)
        left[chosen] = False
        for bounce, heard in bounces_found:
            kept = heard[left[bounce.ray.take(heard)]]
            yield bounce if len(kept) == len(bounce.ray) else bounce[kept]
        if len(chosen) == 0:
            return
        cells = (cap.cells(chosen) if cells is None else cells[chosen]).divided(SPLIT)
        directions, parts, count = cap.towards(cells), cells.parts, cells.middles.shape[1]
        rays = np.arange(count)
        extra -= count
