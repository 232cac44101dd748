# SPDX-License-Identifier: MIT
"""Where the sound goes: rays from the emitter, bounce by bounce."""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from sononerf.geometry.directions import CapSpiral
from sononerf.geometry.raycast import RayCaster
from sononerf.simulation.reflection import keep_outside, mirror


@dataclass(frozen=True, eq=False)
class Bounce:
    """The rays that hit the surface for the n-th time.

    Attributes
    ----------
    number : int
        n, the first hit being 1.
    solid_angle : float, sr
        What each ray stands for.
    ray : (H,) int64
        Which of the emitted rays.
    emitted : (H, 3) float64
        Their directions from the emitter.
    points : (H, 3) float64, m
        Where they hit.
    flat : (H, 3) float64
        Normals of the triangles, on the side of the ray.
    mirrored : (H, 3) float64
        Where a mirror would send them.
    length : (H,) float64, m
        From the emitter along the path.
    """

    number: int
    solid_angle: float
    ray: NDArray[np.int64]
    emitted: NDArray[np.float64]
    points: NDArray[np.float64]
    flat: NDArray[np.float64]
    mirrored: NDArray[np.float64]
    length: NDArray[np.float64]


def aim(
    emitter: NDArray[np.float64], centre: NDArray[np.float64], radius: float
) -> tuple[NDArray[np.float64], float]:
    """Axis and half angle of the cap under which a point sees a ball.

    Parameters
    ----------
    emitter, centre : (3,) float64, m
        The point, and the ball's middle.
    radius : float, m
        Of the ball.

    Returns
    -------
    axis : (3,) float64, m
        Towards the middle, not normalised.
    half_angle : float, rad
        pi where the point is inside.
    """
    axis = centre - emitter
    distance = float(np.linalg.norm(axis))
    if distance <= radius:
        return np.array([1.0, 0.0, 0.0]), math.pi
    return axis, math.asin(radius / distance)


def trace(
    caster: RayCaster,
    emitter: NDArray[np.float64],
    directions: NDArray[np.float64],
    bounces: int,
    *,
    solid_angle: float,
) -> Iterator[Bounce]:
    """Follow rays over mirror bounces.

    A surface is the same from both sides: what a ray hits is outside for it.

    Parameters
    ----------
    caster : RayCaster
        The surface.
    emitter : (3,) float64, m
        Where all rays start.
    directions : (N, 3) float64
        Unit vectors.
    bounces : int
        How often a ray may hit.
    solid_angle : float, sr
        What each ray stands for.

    Yields
    ------
    bounce : Bounce
        One per bounce, as long as any ray hits.
    """
    ray, emitted = np.arange(len(directions)), directions
    origins = np.broadcast_to(emitter, directions.shape)
    length = np.zeros(len(directions))
    for number in range(1, bounces + 1):
        hits = caster.first_hit(origins, directions)
        if len(hits.ray) == 0:
            return
        ray, length = ray[hits.ray], length[hits.ray] + hits.distance
        incoming = directions[hits.ray]
        flat = caster.face_normals[hits.triangle]
        behind = np.einsum("nd,nd->n", incoming, flat) > 0.0
        flat = np.where(behind[:, None], -flat, flat)
        mirrored = mirror(incoming, hits.normals)
        yield Bounce(number, solid_angle, ray, emitted[ray], hits.points, flat, mirrored, length)
        directions = keep_outside(mirrored, flat)
        origins = hits.points + caster.lift * flat


def echo_paths(
    caster: RayCaster,
    emitter: NDArray[np.float64],
    cap: CapSpiral,
    *,
    bounces: int,
    extra: int,
) -> Iterator[Bounce]:
    """Follow the rays of a cap, with more of them where they hit more than once.

    A curved surface spreads neighbouring rays tenfold and more at each bounce, so that a pattern
    that is dense at the first hit is sparse at the second: the echoes of two bounces would be
    noise. The cells of rays that hit twice, and of their neighbours, are divided instead.

    Parameters
    ----------
    caster : RayCaster
        The surface.
    emitter : (3,) float64, m
        Where all rays start.
    cap : CapSpiral
        First rays, world frame.
    bounces : int
        How often a ray may hit.
    extra : int
        At most so many rays come to the first ones.

    Yields
    ------
    bounce : Bounce
        First hits of the first rays, then later hits of the divided ones.
    """
    whole = cap.solid_angle
    first = list(trace(caster, emitter, cap.directions(), min(bounces, 2), solid_angle=whole))
    yield from first[:1]
    if len(first) < 2:
        return
    index = cap.neighbourhood(first[1].ray)
    split = max(1, math.isqrt(extra // len(index)))
    fine = cap.divided(index, split)
    for bounce in trace(caster, emitter, fine, bounces, solid_angle=whole / split**2):
        if bounce.number > 1:
            yield bounce
