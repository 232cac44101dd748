# SPDX-License-Identifier: MIT
"""Start surface by a network that was trained on the evidence of procedural bodies.

Flat faces are silent except in the direction of a mirror, and a hollow is heard at its rim and its
bottom alone. The evidence does not determine the surface in between. A small U-Net [1]_ takes all
evidence on a lattice and returns the signed distance. It was trained on procedural bodies, each of
which went through the whole pipeline, see ``tools/learn_start.py``. Lengths are in range
resolutions and counts are relative to the number of poses, so that size, band and number of poses
may differ.

References:
    .. [1] O. Ronneberger, P. Fischer, T. Brox, "U-Net: convolutional networks for biomedical image
       segmentation", 2015.
"""

from __future__ import annotations

import math
from functools import cache
from itertools import pairwise
from pathlib import Path
from typing import Literal

import numpy as np
import torch
import trimesh
from numpy.typing import NDArray
from safetensors.torch import load_file
from scipy.spatial import cKDTree
from torch import Tensor, nn

from sononerf.array_types import Floats, Singles
from sononerf.echoes.free_space import EchoHull
from sononerf.echoes.range_levels import STATISTICS
from sononerf.errors import NumericalError
from sononerf.geometry.directions import fibonacci_sphere, usual_gap
from sononerf.geometry.lattice import MARGIN, Lattice
from sononerf.surface.start.occupancy import (
    THICKER,
    Gathered,
    planes,
    surface_of,
    thickened,
    winding_of,
    without_hollows,
    without_parts,
)

WEIGHTS = Path(__file__).with_name("learned.safetensors")
"""File of the trained weights, float16."""
VOXEL = 0.25
"""Spacing of the lattice, range resolutions: walls of half a range resolution have two voxels."""
LARGEST = 3_000_000
"""Number of voxels, at most; a larger body gets a coarser lattice. The network takes about 1 µs of
one core per voxel."""
MOST = 20_000
"""Number of points of evidence, at most; it bounds the time."""
USUAL = 400
"""Number of poses to which counts are scaled: counts over poses times this."""
OUTSIDE = 4.0
"""Distance outside of the lattice, voxels; the training clips larger ones to it."""
LOGIT = 0.7
"""Distance at which the logit of the probability that a voxel is outside is 1, voxels; the same in
the training."""
SURE = 3.0
"""Distance from which a voxel is taken to be outside, voxels. Farther voxels are many, and their
small probabilities would add up."""
GAP = 2.0
"""Largest allowed gap between the directions of the poses, over the usual gap of as many random
directions, no unit. In the training, poses surrounded each body. Evenly spread poses have a ratio
of 0.7 to 0.8, a cap over a support 1.5, a turntable before a column 4 to 8. On a column the network
harms: a printed bunny has an F-score at 5 mm of 0.36 with it and of 0.60 without it."""
_LOOKS = 2000  # number of directions in which a gap is looked for: 5 degrees apart
BLOCK = 16
"""Number of voxels along an axis that are one voxel at the coarsest level of the network."""
_REACH = 0.3  # distance outside of the onsets' bound that the lattice covers, range resolutions
_NEGLIGIBLE = 1e-3  # weight of a point that is left out, to save time
_CHUNK = 2000  # points at a time; it bounds the memory
_NEAR = 0.5  # distance outside of the onsets' bound up to which levels are read, range resolutions
VECTORS = 2
"""Number of features that are vectors: mean direction of the sound, and mean normal. They are the
last ones, three components each."""
FEATURES = 16 + STATISTICS + 3
"""Number of features of a voxel."""
OPEN = 13
"""Index of the first of the features that are signed distances of ``BELIEFS``. Their unit is 1.5
range resolutions."""
BELIEFS: tuple[Literal["open", "filled"], ...] = ("open", "filled")
"""Beliefs whose signed distances the network sees."""
CHANNELS = (32, 64, 96, 96)
"""Channels of the network, from fine to coarse."""


def lattice_of(known: Gathered) -> Lattice | None:
    """Return the lattice over all places that the onsets leave; None if they leave none."""
    coarse = known.lattice
    left = np.argwhere(known.bound < _REACH * known.resolution / coarse.spacing)
    if not len(left):
        return None
    lower = coarse.origin + coarse.spacing * (left.min(axis=0) - 1.5)
    upper = coarse.origin + coarse.spacing * (left.max(axis=0) + 1.5)
    spacing = max(VOXEL * known.resolution, float(np.prod(upper - lower) / LARGEST) ** (1 / 3))
    blocks = np.ceil((upper - lower) / (BLOCK * spacing)).astype(int)
    x, y, z = (int(n) * BLOCK for n in blocks)
    origin = (lower + upper) / 2 - spacing * (np.array([x, y, z]) - 1) / 2
    return Lattice(origin, spacing, (x, y, z))


def gap_of_poses(hull: EchoHull, middle: Floats) -> float:
    """Return the ratio of the largest gap between poses that heard something, see ``GAP``.

    Args:
        hull: Onsets and poses; on a support, the image of each pose counts too.
        middle ((3,), m): Middle of the body.
    """
    heard = hull.sources[np.isfinite(hull.trusted).any(axis=1)]
    count = len(heard)
    if not count:
        return math.inf
    if hull.plane is not None:
        heard = np.concatenate([heard, hull.plane.mirrored(heard)])
    near, _ = cKDTree(trimesh.unitize(heard - middle)).query(fibonacci_sphere(_LOOKS))
    return 2 * math.asin(min(float(near.max()) / 2, 1.0)) / usual_gap(count)


def features(known: Gathered, lattice: Lattice) -> Singles:
    """Return the input of the network, (FEATURES, X, Y, Z), no unit.

    Args:
        known: All evidence.
        lattice: From :func:`lattice_of`.
    """
    evidence, coarse, shape = known.evidence, known.lattice, lattice.shape
    unit = lattice.spacing / VOXEL  # one range resolution, unless the lattice is coarser
    poses = max(1, len(known.hull.emitters))
    per = USUAL / poses
    places = lattice.points()
    # Points come pose by pose: an even choice takes as much of each.
    count = len(evidence.points)
    chosen = np.unique(np.linspace(0, count - 1, min(count, MOST)).astype(np.int64))
    per *= count / max(1, len(chosen))
    reliable = known.weight[chosen]
    evidence = evidence.where(chosen)
    some = reliable > _NEGLIGIBLE
    points, normals, weight = evidence.points[some], evidence.normals[some], reliable[some]

    def read(grid: Singles) -> Floats:
        return coarse.read(grid, places).reshape(shape)

    half = Lattice(
        lattice.origin + lattice.spacing / 2,
        2 * lattice.spacing,
        (shape[0] // 2, shape[1] // 2, shape[2] // 2),
    )
    near, near_off = planes(lattice, points, normals, weight)
    wide, wide_off = (_twice(grid) for grid in planes(half, points, normals, weight))
    winding = np.zeros(coarse.shape, np.float32)
    if len(points):
        winding = winding_of(coarse, evidence.points, evidence.normals, evidence.weight)
    far = lattice.spacing * float(np.linalg.norm(shape))

    def sight(points: Floats, ways: Floats, weight: Floats, start: float, stop: float) -> Singles:
        return np.log1p(0.2 * per * _along(lattice, points, ways, weight, start, stop))

    thin = read(known.thin)
    voxel = coarse.spacing / unit
    dense = lattice.spread(points, weight, 2.0)
    size = np.log1p(40 * per * dense) / np.maximum(dense, 1e-9) / 2
    found = [
        np.clip(read(known.bound) * voxel, -3, 3) / 1.5,
        near,
        near * np.clip(near_off, -3, 3) / 2,
        wide,
        wide * np.clip(wide_off, -3, 3) / 2,
        np.clip(read(winding), -1, 1.5),
        sight(points, normals, weight, 0.6 * unit, far) / 2,
        sight(evidence.points, evidence.normals, evidence.weight, 0.6 * unit, far) / 2,
        sight(points, -normals, weight, 0.2 * unit, 1.2 * unit),
        np.log1p(10 * per * lattice.spread(points, weight, 1.0)) / 2,
        np.log1p(62.5 * per * lattice.spread(points, weight, 2.5)) / 2,
        np.log1p(20 * per * lattice.spread(evidence.points, evidence.weight, 1.5)) / 2,
        np.full(shape, np.log(poses / 100) / 2),
        *(
            np.clip((read(thickened(known, belief)) + THICKER * thin) * voxel, -3, 3) / 1.5
            for belief in BELIEFS
        ),
        thin,
        *_level_features(known, half),
        *(size * lattice.spread(points, weight * along, 2.0) for along in normals.T),
    ]
    return np.stack(found).astype(np.float32)


def _level_features(known: Gathered, half: Lattice) -> list[Singles]:
    """Return the statistics of the levels over range, (X, Y, Z) each; zero in free space.

    Args:
        known: All evidence.
        half: Lattice of half as many voxels along each axis.
    """
    levels, places = known.levels, half.points()
    found = np.zeros((STATISTICS, len(places)), np.float32)
    outside = known.lattice.read(known.bound, places) * known.lattice.spacing
    near = outside < _NEAR * known.resolution
    if levels is not None and near.any():
        points = known.evidence.points
        middle = points.mean(axis=0) if len(points) else places[near].mean(axis=0)
        found[:, near] = levels.statistics(places[near], middle).T
    return [_twice(grid.reshape(half.shape)) for grid in found]


def _twice(grid: Singles) -> Singles:
    """Repeat each voxel along each axis."""
    for axis in range(3):
        grid = grid.repeat(2, axis)
    return grid


def _along(
    lattice: Lattice, points: Floats, ways: Floats, weight: Floats, start: float, stop: float
) -> Singles:
    """Return the sum of the weights of the points whose ray passes a voxel, (X, Y, Z).

    The ray of a point runs along its way, a unit vector, from the distance start to stop, m.
    """
    steps = np.arange(start, stop, 0.8 * lattice.spacing)
    total, shape = np.zeros(int(np.prod(lattice.shape))), np.asarray(lattice.shape)
    for first in range(0, len(points), _CHUNK):
        lot = slice(first, first + _CHUNK)
        on_way = points[lot, None] + steps[None, :, None] * ways[lot, None]
        voxel: NDArray[np.intp] = np.rint(lattice.coordinates(on_way)).astype(np.intp)
        within = ((voxel >= 0) & (voxel < shape)).all(axis=2)
        flat = np.ravel_multi_index(tuple(voxel[within].T), lattice.shape)
        counted = np.broadcast_to(weight[lot, None], within.shape)[within]
        total += np.bincount(flat, counted, total.size)
    return total.reshape(lattice.shape).astype(np.float32)


class _Residual(nn.Module):
    def __init__(self, channels: int) -> None:
        super().__init__()
        self.first = nn.Conv3d(channels, channels, 3, padding=1)
        self.second = nn.Conv3d(channels, channels, 3, padding=1)
        for part in self.second.parameters():
            nn.init.zeros_(part)

    def forward(self, values: Tensor) -> Tensor:
        return values + self.second(nn.functional.relu(self.first(values), inplace=True))


class StartNetwork(nn.Module):
    """U-Net from evidence to signed distance; its finest level has blocks of 2 x 2 x 2 voxels.

    It adds to the mean of the signed distances of the beliefs ``open`` and ``filled``.

    Args:
        channels: Number of channels, from fine to coarse.
    """

    def __init__(self, channels: tuple[int, ...] = CHANNELS) -> None:
        super().__init__()
        steps = list(pairwise(channels))
        self.enter = nn.Conv3d(8 * FEATURES, channels[0], 1)
        self.down = nn.ModuleList(_Residual(width) for width in channels)
        self.pool = nn.ModuleList(nn.Conv3d(a, b, 2, stride=2) for a, b in steps)
        self.widen = nn.ModuleList(
            nn.ConvTranspose3d(b, a, 2, stride=2) for a, b in reversed(steps)
        )
        self.up = nn.ModuleList(_Residual(a) for a, _ in reversed(steps))
        self.leave = nn.Conv3d(channels[0], 8, 1)
        for part in self.leave.parameters():
            nn.init.zeros_(part)

    def forward(self, evidence: Tensor) -> Tensor:
        """Return the signed distance, voxels, positive outside, (B, X, Y, Z).

        Args:
            evidence (B, FEATURES, X, Y, Z): From :func:`features`; all sides are multiples of 16.
        """
        batch, count, x, y, z = evidence.shape
        blocks = evidence.reshape(batch, count, x // 2, 2, y // 2, 2, z // 2, 2)
        blocks = blocks.permute(0, 1, 3, 5, 7, 2, 4, 6).flatten(1, 4)
        values = self.enter(blocks.contiguous(memory_format=torch.channels_last_3d))
        levels = [self.down[0](values)]
        for pool, down in zip(self.pool, self.down[1:], strict=True):
            levels.append(down(pool(levels[-1])))
        values = levels.pop()
        for widen, up in zip(self.widen, self.up, strict=True):
            values = up(widen(values) + levels.pop())
        found = self.leave(values).float().unflatten(1, (2, 2, 2))
        found = found.permute(0, 4, 1, 5, 2, 6, 3).reshape(batch, x, y, z)
        mean = (evidence[:, OPEN] + evidence[:, OPEN + 1]).float() / 2
        return 2.0 * found + 1.5 / VOXEL * mean.clamp(-1.5, 1.5)


def expected_level(distance: Singles) -> float:
    """Return the level at which the volume is the expected one, voxels.

    A wire whose place is known less exactly than it is thick is nowhere likelier than air, so that
    the level 0 would lose it.

    Args:
        distance ((X, Y, Z), voxels): Signed distance; some of it is below ``SURE``.
    """
    near = distance[distance < SURE].astype(np.float64)
    expected = int((1 / (1 + np.exp(near / LOGIT))).sum())
    return float(np.partition(near, expected)[expected]) if expected < len(near) else SURE


@cache
def _network() -> StartNetwork:
    network = StartNetwork()
    network.load_state_dict({name: part.float() for name, part in load_file(WEIGHTS).items()})
    return network.eval()


def learned_surface(known: Gathered) -> trimesh.Trimesh:
    """Return the closed surface of the body by the network, m, normals outward.

    Args:
        known: The evidence.

    Raises:
        NumericalError: If the onsets leave no place for a body, or the network finds none, or the
            levels of the echoes are not known, or the poses leave a gap.
    """
    if known.levels is None:
        raise NumericalError("the start learned needs the echoes; their free space is not enough")
    lattice = lattice_of(known)
    if lattice is None:
        raise NumericalError("no surface: the first echoes leave no room for a body")
    middle = lattice.origin + lattice.spacing * (np.asarray(lattice.shape) - 1) / 2
    gap = gap_of_poses(known.hull, middle)
    if gap > GAP:
        raise NumericalError(
            "the start learned was trained on poses from all around a body; these poses leave a "
            f"gap {gap:.1f} times as wide as random poses leave (at most {GAP:g} is allowed); "
            "take another method, such as open"
        )
    with torch.no_grad():
        seen = torch.from_numpy(features(known, lattice))[None]
        distance = _network()(seen)[0].numpy()
    if not (distance < SURE).any():
        raise NumericalError("no surface: the network finds no body in the evidence")
    distance = np.minimum(distance - expected_level(distance), OUTSIDE)
    x, y, z = (n + 2 * MARGIN for n in lattice.shape)
    wider = Lattice(lattice.origin - MARGIN * lattice.spacing, lattice.spacing, (x, y, z))
    distance = np.pad(distance, MARGIN, constant_values=OUTSIDE)
    distance = without_parts(without_hollows(distance), wider, known)
    return surface_of(distance, wider)
