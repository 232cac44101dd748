# SPDX-License-Identifier: MIT
r"""Error of a surface per vertex, from single poses that contradict it and from its start surfaces.

The displacement along the normals is a sum of bumps, one per ``SPACING`` of surface. Of each bump a
pose gives the gradient g of the squared misfit, and the curvature h of that misfit (Gauss and
Newton), by probes with random signs [1]_; the unit of displacement is ``PRIOR``. If the misfits
were noise, the squares of g would have the mean h. Errors of the surface and of physical optics
make them larger by the factor

.. math:: u = \frac{1 + \sum g^2}{1 + \sum h}

(the quotient of Huber's robust covariance [2]_ and the usual one). The variance of the displacement
over that before anything is heard is :math:`v = 1 / (1 + \sum h)`. The error of a vertex is

.. math:: \epsilon = \epsilon_0\, \lambda\, u^a\, v^b\, (\kappa_0 + \lambda\kappa)^c\,
    (s_0 + s / \lambda)^e\, d^f

with ``ERROR_SCALE``, ``CURVATURE_FLOOR`` and ``DISTANCE_FLOOR`` for :math:`\epsilon_0`,
:math:`\kappa_0` and :math:`s_0`, the shortest wavelength :math:`\lambda`, and

- the concave curvature :math:`\kappa`: physical optics has no echo between the walls of a hollow;
- the median distance s of the start surfaces: where they agree, the echoes leave little open;
- the error d of the validation poses in decibels.

The exponents were fitted to bodies whose surface is known, see ``docs/method.md``.

References:
    .. [1] C. Bekas, E. Kokiopoulou, Y. Saad, "An estimator for the diagonal of a matrix", Applied
       Numerical Mathematics 57, 2007.
    .. [2] P. J. Huber, "The behavior of maximum likelihood estimates under nonstandard conditions",
       Berkeley Symposium 5(1), 1967.
"""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Collection
from dataclasses import dataclass
from typing import Literal, get_args

import numpy as np
import torch
import trimesh
from scipy.sparse import csr_array
from scipy.spatial import cKDTree
from torch import Tensor

from sononerf.echoes.echoes import Echoes
from sononerf.errors import InputError, expect
from sononerf.geometry.directions import fibonacci_cap, fibonacci_sphere
from sononerf.geometry.poses import Poses
from sononerf.numerics import Bools, Floats, Ints
from sononerf.progress import Progress
from sononerf.refinement.objective import ErrorLevel, differences, measured
from sononerf.refinement.optics import Heard, Optics
from sononerf.refinement.remesh import distance_from, sparse_tensor
from sononerf.refinement.tracer import StillSurface
from sononerf.start.surface import Surface

MAX_ERROR_POSES = 48
"""Number of training poses, at most, that are rendered: 3 seconds for three spheres."""
PROBES = 2
"""Number of random probes per pose; exponents and scale were calibrated with it."""
SPACING = 1.5
"""Distance between bumps, shortest wavelengths: about what sound resolves along the surface."""
PRIOR = 0.5
"""Standard deviation of a bump before anything is heard, shortest wavelengths. Twice as much
changes the area of the sparsification error by 0.002."""
AVERAGING_WIDTH = 2.0
"""Standard deviation of the weights around a vertex over which u is averaged, wavelengths. The
average lowers the area of the sparsification error from 0.37 to 0.33."""
EXPONENTS = (0.11, 0.06, 0.14, 0.32, 1.38)
"""Exponents a, b, c, e and f; from `tools/benchmark.py errors --calibrate`, rounded, as is the
scale."""
CURVATURE_FLOOR = 0.05
"""Curvature times wavelength that is added, no unit: a flat surface has an error too."""
DISTANCE_FLOOR = 0.03
"""Distance of the start surfaces that is added, wavelengths: they may agree by chance."""
TYPICAL_DISTANCE = 0.3
"""The same distance where there are no two starts to compare, wavelengths: about their median."""
ERROR_SCALE = 0.17
"""Error of a vertex where all factors are 1, wavelengths."""
MAX_VARIANCE = 0.8
"""v above which a vertex is unheard: echoes lower the variance by less than a fifth."""
TWICE = (-0.47, -0.19)
"""Logarithm of the factor by which twice as many poses change the error of a surface: its value at
an error of one wavelength, and its slope over the logarithm of the error. A regression on 30 bodies
from 100 and 400 calls, ``docs/results.md``; the rest has a standard deviation of 0.33."""
POSES = 8
"""Number of poses that are rendered at a time; it bounds the memory."""


@dataclass(frozen=True, eq=False)
class SurfaceError:
    """Error of the vertices of a surface."""

    # (V,), m: The true surface is within this distance with a probability of 90 %, if the vertex
    # was heard
    error: Floats
    heard: Bools  # (V,): True where echoes bound the place of the surface
    factors: Floats  # (V, 5): The factors of the error, without their exponents


def surface_error(
    mesh: trimesh.Trimesh,
    echoes: Echoes,
    optics: Optics,
    *,
    starts: Collection[trimesh.Trimesh],
    validation_db: float,
    seed: int,
) -> SurfaceError:
    """Return the error of a surface."""
    bumps, wavelength = Bumps(mesh, optics), optics.wavelength
    misfit = Misfit(bumps, echoes, seed)
    points = bumps.vertices.cpu().numpy()
    around = _weights(points, points[bumps.centres], AVERAGING_WIDTH * wavelength)
    excess = around @ ((1.0 + misfit.gradient) / (1.0 + misfit.curvature))
    variance = bumps.spread @ (1.0 / (1.0 + misfit.curvature))
    apart: Floats = np.full(len(points), TYPICAL_DISTANCE * wavelength)
    if len(starts) > 1:
        apart = np.median([distance_from(one, points, 0.5 * wavelength) for one in starts], axis=0)
    hollow, agreement = (
        CURVATURE_FLOOR + wavelength * bumps.hollow,
        DISTANCE_FLOOR + apart / wavelength,
    )
    error_db = np.full(len(points), validation_db)
    factors = np.stack([excess, variance, hollow, agreement, error_db], axis=1)
    error = ERROR_SCALE * wavelength * np.prod(factors**EXPONENTS, axis=1)
    return SurfaceError(error, variance < MAX_VARIANCE, factors)


def error_from_twice(error: float, wavelength: float) -> float:
    """Return the error that a surface would have from twice as many poses, m.

    In: error (m), wavelength (m).
    """
    at_one, slope = TWICE
    return error * min(1.0, math.exp(at_one + slope * math.log(error / wavelength)))


class Bumps:
    """Smooth displacements along the normals of a surface.

    Attributes:
        vertices, normals ((V, 3) float64): Places (m) and outward unit normals.
        centres (B,): Vertices in the middle of the bumps.
        matrix (V, B): Displacement by each bump; the squares of a row add up to 1.
        spread (V, B): These squares.
        hollow ((V,), 1/m): Concave curvature; 0 where the surface is convex.
    """

    def __init__(self, mesh: trimesh.Trimesh, optics: Optics) -> None:
        self.optics, self._surface = optics, StillSurface(mesh, optics)
        self.vertices, self.normals = self._surface.vertices, self._surface.normals
        xx, yy, zz, xy, xz, yz = self._surface.bending.cpu().numpy().T
        tensors = np.stack([xx, xy, xz, xy, yy, yz, xz, yz, zz], axis=1).reshape(-1, 3, 3)
        self.hollow = np.maximum(-np.linalg.eigvalsh(tensors)[:, 0], 0.0)
        # The sides of a thin body have bumps of their own.
        spacing = SPACING * optics.wavelength
        places = np.concatenate([mesh.vertices / spacing, self.normals.cpu().numpy()], axis=1)
        self.centres = _cover(places)
        near = _weights(places, places[self.centres], math.sqrt(0.5))
        norm = np.sqrt(near.multiply(near).sum(axis=1))
        self.matrix = csr_array(near.multiply(1.0 / norm[:, None]))
        self.spread = self.matrix.multiply(self.matrix).tocsr()
        self._moves = sparse_tensor(self.matrix).to(self.vertices.device)

    def render(self, positions: Floats, rotations: Floats) -> tuple[Heard | None, Tensor]:
        """Render poses.

        In: positions, rotations ((P, 3), (P, 3, 3)). Out: moves ((P, B) float64).
        """
        moves = torch.zeros(len(positions), len(self.centres), dtype=torch.float64)
        moves = moves.to(self.vertices).requires_grad_(True)
        pieces, heads, middle = self._surface.listen(positions, rotations)
        if not len(pieces.pose):
            return None, moves
        # Each pose has a surface of its own, so that its gradients stay apart.
        moved = (self._moves @ moves.T).T[:, :, None] * self.normals + self.vertices
        areas = torch.cat([self._surface.operators.areas(one) for one in moved])
        own = pieces.pose % len(positions) * len(self.vertices) + pieces.vertex
        points = (moved - middle).flatten(0, 1).float()
        pieces = dataclasses.replace(pieces, vertex=own)
        return self.optics.render(points, areas.float(), pieces, heads), moves


class Misfit:
    """Squared misfit of training poses over the bumps; the unit of displacement is ``PRIOR``.

    Attributes:
        gradient, curvature (B,): Sums over the training poses of squared gradient, and of
            curvature.
    """

    def __init__(self, bumps: Bumps, echoes: Echoes, seed: int) -> None:
        self.bumps, training, optics = bumps, echoes.training, bumps.optics
        like = optics.get_buffer("wavenumber")
        self._level = ErrorLevel(optics.ears, len(optics.frequencies), like)
        rng = np.random.default_rng(seed)
        chosen = rng.choice(training, min(MAX_ERROR_POSES, len(training)), replace=False)
        self._random = torch.Generator().manual_seed(seed)
        gradient, curvature = torch.zeros(2, len(bumps.centres), dtype=torch.float64)
        square, count = 0.0, 0
        for learn in (True, False):
            for lot in np.array_split(chosen, -(-len(chosen) // POSES)):
                heard, moves = bumps.render(echoes.positions[lot], echoes.rotations[lot])
                if heard is None:
                    continue
                found = measured(echoes, lot.tolist(), heard)
                off, weight = differences(heard, None, found, self._level, learn=learn)
                if learn:
                    continue
                weight = weight * (weight > 0).sum((1, 2, 3), keepdim=True)
                still = off.detach()
                square += float((weight * still.square()).sum())
                count += int((weight > 0).sum())
                curvature += self._probed(off, weight, moves).sum(0)
                (slope,) = torch.autograd.grad((off * weight * still).sum(), moves)
                gradient += slope.cpu().square().sum(0)
        usual = max(square, 1e-30) / max(count, 1)
        self._unit = (PRIOR * optics.wavelength) ** 2 / usual
        factor = self._unit * len(training) / len(chosen)
        self.gradient, self.curvature = (
            (gradient * factor / usual).numpy(),
            (curvature * factor).numpy(),
        )

    def of_poses(self, positions: Floats, rotations: Floats) -> Floats:
        """Return the curvature that poses would add if they heard the surface, (P, B).

        In: positions, rotations ((P, 3), (P, 3, 3)).
        """
        heard, moves = self.bumps.render(positions, rotations)
        if heard is None:
            return np.zeros(moves.shape)
        power = heard.power.detach()
        rendered = power.sqrt() * self._level.gain.exp()[:, None]
        inside = torch.ones_like(power[:, :1, :, :1], dtype=torch.bool)
        found = rendered, inside, rendered.amax((1, 2, 3))
        off, weight = differences(heard, None, found, self._level, learn=False)
        weight = weight * (weight > 0).sum((1, 2, 3), keepdim=True)
        return np.asarray(self._probed(off, weight, moves) * self._unit)

    def _probed(self, off: Tensor, weight: Tensor, moves: Tensor) -> Tensor:
        """Return the curvature (P, B) of the weighted squares of differences, by probes."""
        derivatives = torch.zeros(moves.shape, dtype=torch.float64)
        for _ in range(PROBES):
            signs = torch.randint(0, 2, off.shape, generator=self._random) * 2 - 1
            probe = weight.sqrt() * signs.to(off)
            (slope,) = torch.autograd.grad((off * probe).sum(), moves, retain_graph=True)
            derivatives += slope.cpu().square() / PROBES
        return derivatives


def _cover(places: Floats) -> Ints:
    """Return a subset of points (N, K): each other one is within a distance of 1 of it."""
    tree, left, centres = cKDTree(places), np.ones(len(places), dtype=bool), []
    for number, place in enumerate(places):
        if left[number]:
            centres.append(number)
            left[tree.query_ball_point(place, 1.0)] = False
    return np.array(centres, dtype=np.int64)


def _weights(points: Floats, centres: Floats, spread: float) -> csr_array:
    """Return Gaussian weights (N, B) of centres (B, K) around points (N, K); rows add up to 1."""
    near = cKDTree(points).sparse_distance_matrix(
        cKDTree(centres), 3.0 * spread, output_type="coo_matrix"
    )
    weights = csr_array(near)
    weights.data = np.exp(-0.5 * (weights.data / spread) ** 2)
    return csr_array(weights.multiply(1.0 / weights.sum(axis=1)[:, None]))


Within = Literal["sphere", "cap", "volume"]
"""Places of candidates. ``sphere``: all around the surface, at the median distance of the poses.
``cap``: on that sphere, not farther from the middle of the poses than these are. ``volume``: all
around, between the least and the greatest distance of the poses."""
CANDIDATES = 300
"""Number of candidates: on a sphere they are 12 degrees apart."""

MIN_POSE_GAP = 0.7
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
        candidates: Poses to choose from; those of ``within`` by default.
        within: Places of candidates, which look at the middle of the surface.
        seed: Seed of poses and probes.
        progress: Display of progress; on stderr by default.

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
    directions, heard = (
        out / np.linalg.norm(out, axis=1, keepdims=True)
        for out in (candidates.positions - middle, echoes.positions[echoes.training] - middle)
    )
    return candidates[_greedy(weight, 1.0 + misfit.curvature, added, count, directions, heard)]


def _greedy(
    weight: Floats,
    information: Floats,
    added: Floats,
    count: int,
    directions: Floats,
    heard: Floats,
) -> list[int]:
    """Return the rows of ``added`` (P, B) that reduce the sum of weight / sqrt(known) most.

    In: weight, information (B,), added (P, B), ways, heard ((P, 3), (H, 3)).
    """
    chosen: list[int] = []
    error = weight * np.sqrt(information)  # error = weight where nothing is added
    gap, _ = cKDTree(heard).query(directions)
    for _ in range(count):
        after = (error / np.sqrt(information + added)).sum(axis=1)
        left = gap >= MIN_POSE_GAP * gap.max()
        left[chosen] = False
        best = int(np.where(left, after, np.inf).argmin())
        chosen.append(best)
        gap = np.minimum(gap, np.linalg.norm(directions - directions[best], axis=1))
        information = information + added[best]
    return chosen


def _candidates(surface: Surface, echoes: Echoes, within: Within, count: int, seed: int) -> Poses:
    middle = surface.mesh.bounds.mean(axis=0)
    out = echoes.positions[echoes.training] - middle
    distance = np.linalg.norm(out, axis=1)
    directions: Floats = fibonacci_sphere(count)
    far: Floats = np.full(count, np.median(distance))
    if within == "cap":
        axis = (out / distance[:, None]).mean(axis=0)
        axis /= max(float(np.linalg.norm(axis)), 1e-12)
        widest = float(np.arccos(np.clip(out @ axis / distance, -1.0, 1.0)).max())
        half = min(widest, math.pi)
        directions = fibonacci_cap(count, axis=axis, half_angle=half, offset=(0.5, 0.0))
    if within == "volume":
        depth = np.random.default_rng(seed).random(count)
        far = np.cbrt(distance.min() ** 3 + depth * (distance.max() ** 3 - distance.min() ** 3))
    return Poses.looking_at(middle + far[:, None] * directions, middle)


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
