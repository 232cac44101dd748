# SPDX-License-Identifier: MIT
"""The surface of what first echoes leave, where no sound was heard through it.

First echoes bound a body from outside, flat and silent faces too. Over a hollow or a gap they leave
a film instead of a surface; what is heard from behind tells that there is nothing to it.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from sononerf.echoes.free_space import EchoHull
from sononerf.errors import NumericalError
from sononerf.reconstruction.glints import Glints
from sononerf.reconstruction.isosurface import isosurface
from sononerf.reconstruction.volume import Volume, grid_over

Array = NDArray[np.float64]
COARSER = 4
"""The hull is first looked at so many times more coarsely."""
BEAM = 0.006
"""Sound on its way to an ear needs a free way so wide to each side, m: a wavelength in mid
band."""
SPREAD = 0.8
"""And so much more per distance and angle between poses: there are no looks in between."""
BEHIND = 0.004
"""A glint is heard through a film if it lies so far behind it, m, not beside it."""
THROUGH = 0.001
"""A film is where the trust of all that was heard through it is more than this, times the root of
the number of poses: the more poses, the more of what is heard is heard wrongly."""
HEARD = 0.5
"""Glints that are trusted less than this part of that are not taken for sound."""
NEIGHBOURS = 10
ONE_SIDE = 2.6
"""A pose is outermost where its nearest neighbours leave so wide an angle free, rad."""
AROUND = 0.05
"""Poses surround a body if fewer than this part of them are outermost."""
BESIDE = 0.012
"""Otherwise points count that lie so near to a glint of the pose that bounds them, m."""
CHUNK = 128


def clearance_volume(hull: EchoHull, lower: Array, upper: Array, spacing: float) -> Volume:
    """Return how far each voxel lies behind the first echoes, m; exact near zero.

    Parameters
    ----------
    hull : EchoHull
        What the first echoes leave.
    lower, upper : (3,) float, m
        The box.
    spacing : float, m
        Voxel size.

    Returns
    -------
    clearance : Volume
        On the grid of :func:`grid_over`. Its slope is at most one, so voxels that a coarse look
        finds far from zero need no second one.
    """
    grid = grid_over(lower, upper, spacing)
    coarse = [np.unique(np.append(np.arange(0, n, COARSER), n - 1)) for n in grid.shape]
    corners = np.stack(np.meshgrid(*coarse, indexing="ij"), axis=-1).reshape(-1, 3)
    far = 2 * float(np.linalg.norm(upper - lower))
    found = np.minimum(hull.clearance(grid.origin + spacing * corners)[0], far)
    values = found.reshape([len(c) for c in coarse])
    for axis, (picked, count) in enumerate(zip(coarse, grid.shape, strict=True)):
        at = np.interp(np.arange(count), picked, np.arange(len(picked)))
        left = np.minimum(at.astype(int), max(len(picked) - 2, 0))
        part = (at - left).reshape([-1 if a == axis else 1 for a in range(3)])
        right = np.minimum(left + 1, len(picked) - 1)
        values = values.take(left, axis) * (1 - part) + values.take(right, axis) * part
    near = np.abs(values) < COARSER * spacing
    places = grid.origin + spacing * np.argwhere(near)
    values[near] = np.minimum(hull.clearance(places)[0], far)
    return Volume(values, grid.origin, spacing)


def outline(hull: EchoHull, clearance: Volume, glints: Glints, trust: Array) -> tuple[Array, Array]:
    """Return points of the hull's surface that nothing was heard through.

    Parameters
    ----------
    hull : EchoHull
        What the first echoes leave.
    clearance : Volume
        Its :func:`clearance_volume`.
    glints : Glints
        What was heard.
    trust : (G,) float
        How far each is believed.

    Returns
    -------
    points : (N, 3) float, m
        About one per voxel of the surface; none where it has none in the box.
    normals : (N, 3) float
        Unit vectors towards the poses that bound it there.
    """
    try:
        points = np.asarray(isosurface(clearance, 0.0).vertices, dtype=np.float64)
    except NumericalError:
        return np.zeros((0, 3)), np.zeros((0, 3))
    depth, bounded_by = hull.clearance(points)
    bounded = np.abs(depth) < clearance.spacing  # not by the box
    points, bounded_by = points[bounded], bounded_by[bounded]
    normals = hull.sources[bounded_by] - points
    if not len(points):
        return points, normals
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    heard = trust > HEARD * _enough(hull)
    through = _heard_through(points, normals, glints.where(heard), trust[heard], hull.sources)
    # Each first echo came from somewhere on the film that its pose bounds.
    least = np.full(len(hull.first), np.inf)
    np.minimum.at(least, bounded_by, through)
    solid = through <= np.maximum(_enough(hull), least[bounded_by])
    solid &= _beside_a_glint(points, bounded_by, hull, glints)
    return points[solid], normals[solid]


def _beside_a_glint(
    points: Array, bounded_by: NDArray[np.intp], hull: EchoHull, glints: Glints
) -> NDArray[np.bool_]:
    """Return which points lie beside what the pose that bounds them heard, (N,).

    Poses that surround a body look through its gaps from all sides, and all points count. From one
    side alone a gap and a silent face are the same.
    """
    outermost = _outermost(hull.sources, points.mean(axis=0))
    if outermost.mean() < AROUND:
        return np.ones(len(points), dtype=bool)
    nearest = np.full(len(points), np.inf)
    for pose in np.unique(bounded_by):
        film, heard = bounded_by == pose, glints.points[glints.pose == pose]
        if len(heard):
            nearest[film] = cKDTree(heard).query(points[film])[0]
    return np.asarray(nearest < BESIDE)


def _outermost(sources: Array, middle: Array) -> NDArray[np.bool_]:
    """Return the poses that have neighbours to one side only, (P,)."""
    around = sources - middle
    around /= np.linalg.norm(around, axis=1, keepdims=True)
    count = min(NEIGHBOURS + 1, len(around))
    near = cKDTree(around).query(around, k=count)[1].reshape(len(around), -1)[:, 1:]
    first = np.cross(around, np.eye(3)[np.abs(around).argmin(axis=1)])
    first /= np.linalg.norm(first, axis=1, keepdims=True)
    second = np.cross(around, first)
    steps = around[near] - around[:, None]
    angles = np.sort(
        np.arctan2((steps * second[:, None]).sum(-1), (steps * first[:, None]).sum(-1)), axis=1
    )
    gaps = np.diff(angles, axis=1, append=angles[:, :1] + 2 * np.pi)
    return np.asarray(gaps.max(axis=1, initial=0.0) > ONE_SIDE) | (count == 1)


def _enough(hull: EchoHull) -> float:
    """Return the trust that makes a film."""
    return THROUGH * float(np.sqrt(len(hull.first)))


def _heard_through(
    points: Array, facing: Array, glints: Glints, trust: Array, sources: Array
) -> Array:
    """Sum the trust of the glints that were heard through each point, (N,)."""
    spread = np.float32(SPREAD * _angle_between(sources))
    middle = points.mean(axis=0)
    films = (points - middle).astype(np.float32)  # half the memory, and micrometres are enough
    squared = (films**2).sum(axis=1)[:, None]
    facing = facing.astype(np.float32)
    level = (films * facing).sum(axis=1)
    through = np.zeros(len(points))
    for some in np.split(np.arange(len(trust)), range(CHUNK, len(trust), CHUNK)):
        there = (glints.points[some] - middle).astype(np.float32)
        normals = glints.normals[some].astype(np.float32)
        along = films @ normals.T
        along -= (there * normals).sum(axis=1)
        off = films @ (-2 * there.T)
        off += squared + (there**2).sum(axis=1)
        off -= along**2
        # In the middle of the way more surely than at its border.
        heard = 1 - off / (np.float32(BEAM) + spread * along.clip(0)) ** 2
        heard[level[:, None] - facing @ there.T < BEHIND] = 0
        heard[along < 0] = 0
        through += heard.clip(0) @ trust[some].astype(np.float32)
    return through


def _angle_between(sources: Array) -> float:
    """Return the usual angle between neighbouring poses, seen from their middle."""
    if len(sources) < 2:
        return np.pi
    around = sources - sources.mean(axis=0)
    next_one = cKDTree(around).query(around, k=2)[0][:, 1]
    return float(np.median(next_one) / np.median(np.linalg.norm(around, axis=1)))
