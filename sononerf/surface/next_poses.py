# SPDX-License-Identifier: MIT
"""Poses that would reduce the error of a surface most, if they were heard next."""

from __future__ import annotations

import math
from typing import Literal, get_args

import numpy as np
from scipy.spatial import cKDTree

from sononerf.echoes.echoes import Echoes
from sononerf.errors import InputError, expect
from sononerf.geometry.directions import fibonacci_cap, fibonacci_sphere
from sononerf.geometry.poses import Poses
from sononerf.numerics import Floats
from sononerf.progress import Progress
from sononerf.surface.refine.optics import Optics
from sononerf.surface.refine.surface_error import POSES, Bumps, Misfit
from sononerf.surface.surface import Surface

Within = Literal["sphere", "cap", "volume"]
"""Places of candidates. ``sphere``: all around the surface, at the median distance of the poses.
``cap``: on that sphere, not farther from the middle of the poses than these are. ``volume``: all
around, between the least and the greatest distance of the poses."""
CANDIDATES = 300
"""Number of candidates: on a sphere they are 12 degrees apart."""

SPREAD = 0.7
"""Least gap between a chosen pose and all others; the unit is the greatest gap of a candidate.
Where a surface is wrong, so are the directions of its mirrors, and poses far apart serve better."""


def next_poses(
    surface: Surface,
    echoes: Echoes,
    count: int,
    *,
    candidates: Poses | None = None,
    within: Within = "sphere",
    seed: int = 0,
    progress: Progress | None = None,
) -> Poses:
    """Return the poses that would reduce the summed error of a surface most.

    One after the other is chosen among the candidates (greedy). A pose reduces the error of a
    vertex as its echoes sharpen the misfit there: it must see the vertex near the direction of a
    mirror, through beam and ears.

    Args:
        surface: Refined, with errors.
        echoes: Echoes that were heard so far.
        count: Number of poses.
        candidates: Poses to choose among; those of ``within`` where None.
        within: Places of candidates, which look at the middle of the surface.
        seed: Seed of poses and probes.
        progress: Display of progress; on stderr where None.

    Returns:
        poses: The best one first.

    Raises:
        InputError: If the surface has no errors, there are too few candidates, or one of them can
            hear nothing of the surface.
    """
    expect(surface, Surface, "surface")
    expect(echoes, Echoes, "echoes")
    if surface.error is None:
        raise InputError("the surface has no errors; refine it against its echoes first")
    if within not in get_args(Within):
        raise InputError(f"within: found {within!r}; give {', '.join(get_args(Within))}")
    if candidates is None:
        candidates = _candidates(surface, echoes, within, max(CANDIDATES, count), seed)
    if not 1 <= count <= len(candidates):
        raise InputError(f"count: found {count}; give 1 to {len(candidates)}, the candidates")
    _check(candidates, surface, echoes)
    bumps = Bumps(surface.mesh, Optics(echoes.head))
    misfit = Misfit(bumps, echoes, seed)
    added = np.zeros((len(candidates), len(bumps.centres)))
    with (progress or Progress()).task("trying poses", len(candidates)) as task:
        for start in range(0, len(candidates), POSES):
            some = candidates[start : start + POSES]
            added[start : start + POSES] = misfit.of_poses(some.positions, some.rotations)
            task.advance(len(some))
    mesh = surface.mesh
    corners = np.bincount(
        mesh.faces.ravel(), np.repeat(mesh.area_faces / 3.0, 3), minlength=len(mesh.vertices)
    )
    weight = bumps.spread.T @ (corners * surface.error)
    middle = mesh.bounds.mean(axis=0)
    ways, heard = (
        out / np.linalg.norm(out, axis=1, keepdims=True)
        for out in (candidates.positions - middle, echoes.positions[echoes.training] - middle)
    )
    return candidates[_greedy(weight, 1.0 + misfit.curvature, added, count, ways, heard)]


def _greedy(
    weight: Floats, information: Floats, added: Floats, count: int, ways: Floats, heard: Floats
) -> list[int]:
    """Return the rows of ``added`` (P, B) that reduce the sum of weight / sqrt(known) most.

    In: weight, information (B,), added (P, B), ways, heard ((P, 3), (H, 3)).
    """
    chosen: list[int] = []
    error = weight * np.sqrt(information)  # error = weight where nothing is added
    gap, _ = cKDTree(heard).query(ways)
    for _ in range(count):
        after = (error / np.sqrt(information + added)).sum(axis=1)
        left = gap >= SPREAD * gap.max()
        left[chosen] = False
        best = int(np.where(left, after, np.inf).argmin())
        chosen.append(best)
        gap = np.minimum(gap, np.linalg.norm(ways - ways[best], axis=1))
        information = information + added[best]
    return chosen


def _candidates(surface: Surface, echoes: Echoes, within: Within, count: int, seed: int) -> Poses:
    middle = surface.mesh.bounds.mean(axis=0)
    out = echoes.positions[echoes.training] - middle
    distance = np.linalg.norm(out, axis=1)
    ways: Floats = fibonacci_sphere(count)
    far: Floats = np.full(count, np.median(distance))
    if within == "cap":
        axis = (out / distance[:, None]).mean(axis=0)
        axis /= max(float(np.linalg.norm(axis)), 1e-12)
        widest = float(np.arccos(np.clip(out @ axis / distance, -1.0, 1.0)).max())
        half = min(widest, math.pi)
        ways = fibonacci_cap(count, axis=axis, half_angle=half, offset=(0.5, 0.0))
    if within == "volume":
        depth = np.random.default_rng(seed).random(count)
        far = np.cbrt(distance.min() ** 3 + depth * (distance.max() ** 3 - distance.min() ** 3))
    return Poses.looking_at(middle + far[:, None] * ways, middle)


def _check(candidates: Poses, surface: Surface, echoes: Echoes) -> None:
    """Refuse candidates that are too near to the surface's box, or too far from it, to hear it."""
    lower, upper = surface.mesh.bounds
    places, ranges = candidates.positions, echoes.head.range
    gap = np.maximum(np.maximum(lower - places, places - upper), 0.0)
    nearest = np.linalg.norm(gap, axis=1)
    deaf = np.flatnonzero((nearest == 0.0) | (nearest > ranges[-1]))
    if len(deaf):
        worst = deaf[0]
        raise InputError(
            f"candidate {worst} (the first is 0) is {nearest[worst]:.3g} m from the box around the "
            f"surface; give places outside the box and within {ranges[-1]:.3g} m; metres"
        )
