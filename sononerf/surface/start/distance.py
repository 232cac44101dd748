# SPDX-License-Identifier: MIT
r"""A signed distance from planes that are known in places, bounded from below.

.. math::
    E(s) = \sum_x a\, \rho(s - t) + \lambda\, |\nabla^2 s|^2 + m\, |s - b| + o\, (b - s)_+^2
           + e\, (1 - s)_+^2

Where oriented points lie, :math:`t` is the distance to their planes and :math:`a` their weight;
:math:`\rho` is Cauchy's robust loss. Between them the surface bends as little as it can [1]_. The
bound :math:`b` is what the onsets leave: :math:`s` must not lie below it, and with no other
evidence lies on it. Where :math:`e` is above zero nothing should be. All terms but the loss are
convex; it is solved by reweighted least squares, with conjugate gradients, from coarse to fine.

References
----------
.. [1] F. Calakli, G. Taubin, "SSD: Smooth signed distance surface reconstruction", Computer
   Graphics Forum 30(7), 2011.
"""

from __future__ import annotations

import numpy as np
from scipy import ndimage

from sononerf.geometry.lattice import Grid

_ROBUST = 1.5  # voxels, scale of Cauchy's loss: evidence farther off the surface hardly counts
_OUTER, _INNER = 4, 40  # rounds of reweighting, steps of conjugate gradients in each
_COARSEST = 12  # least voxels along an axis of the coarsest grid
_ACCURACY = 1e-3  # of the residual's norm, where conjugate gradients stop


def signed_distance(
    weight: Grid, target: Grid, bound: Grid, pull: float, empty: Grid, bending: float
) -> Grid:
    """Return the signed distance, positive outside.

    Parameters
    ----------
    weight : (X, Y, Z) float
        Of the targets, from 0 to 1.
    target : (X, Y, Z) float, voxels
        Signed distance by the evidence.
    bound : (X, Y, Z) float, voxels
        What the distance must not lie below.
    pull : float
        Weight of the distance to the bound.
    empty : (X, Y, Z) float
        Weight with which a place is outside.
    bending : float
        Weight of the squared Laplacian.

    Returns
    -------
    distance : (X, Y, Z) float, voxels
    """
    if min(weight.shape) >= 2 * _COARSEST:
        coarse = _halved(weight)
        moment = _halved(np.asarray(weight * target, dtype=np.float32))
        aim: Grid = (moment / np.maximum(coarse, 1e-9)).astype(np.float32)
        # Values stay in fine voxels, so a Laplacian on twice the spacing is four times as small.
        first = signed_distance(coarse, aim, _halved(bound), pull, _halved(empty), bending / 16)
        distance = ndimage.zoom(first, 2, order=1, mode="nearest", grid_mode=True)
        distance = distance[tuple(slice(n) for n in weight.shape)].astype(np.float32)
    else:
        distance = bound.copy()
    for turn in range(_OUTER):
        robust = 1 / (1 + ((distance - target) / _ROBUST) ** 2)
        gap = distance - bound
        held = pull / np.maximum(np.abs(gap), 1.0) + (gap < 0)
        data, free = weight * robust, np.where(distance < 1.0, empty, 0.0)
        distance = _conjugate_gradients(
            distance,
            (data + held + free).astype(np.float32),
            (data * target + held * bound + free).astype(np.float32),
            bending,
            _INNER if turn else 2 * _INNER,
        )
    return distance


def _halved(grid: Grid) -> Grid:
    """Average blocks of eight; an odd last layer counts twice."""
    padded = np.pad(grid, [(0, n % 2) for n in grid.shape], mode="edge")
    x, y, z = (n // 2 for n in padded.shape)
    return np.asarray(padded.reshape(x, 2, y, 2, z, 2).mean(axis=(1, 3, 5)), dtype=np.float32)


def _laplacian(values: Grid) -> Grid:
    result = np.zeros_like(values)
    for axis in range(3):
        step = np.diff(values, axis=axis)
        before = tuple(slice(None, -1) if a == axis else slice(None) for a in range(3))
        behind = tuple(slice(1, None) if a == axis else slice(None) for a in range(3))
        result[before] += step
        result[behind] -= step
    return result


def _conjugate_gradients(x: Grid, diagonal: Grid, right: Grid, bending: float, steps: int) -> Grid:
    """Solve (diagonal + bending Laplacian²) x = right, from x on."""

    def product(v: Grid) -> Grid:
        return np.asarray(diagonal * v + bending * _laplacian(_laplacian(v)), dtype=np.float32)

    scale = 1 / (diagonal + np.float32(42 * bending))  # 42: on the diagonal of Laplacian²
    x = x.copy()
    residual = right - product(x)
    way = scale * residual
    size = first = float((residual * way).sum())
    for _ in range(steps):
        if not size > _ACCURACY**2 * first:
            break
        turned = product(way)
        length = np.float32(size / float((way * turned).sum()))
        x += length * way
        residual -= length * turned
        scaled = scale * residual
        before, size = size, float((residual * scaled).sum())
        way = scaled + np.float32(size / before) * way
    return x
