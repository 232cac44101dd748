# SPDX-License-Identifier: MIT
"""Oriented evidence: where on its lines of sight each pose hears a field, and how loudly.

The fit brings the *sound* of a field to its range within a tenth of a millimetre. The places that
make it need not lie there, because places closer than the range resolution share one echo. So each
place is moved to the mean range of the sound around it, on the line of sight through the mean of
that sound. The result is a point of the surface whose normal looks at the pose.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
import torch
from numpy.typing import NDArray
from scipy import ndimage, sparse
from scipy.spatial import cKDTree
from torch import Tensor

from sononerf.field.field import Field
from sononerf.geometry.lattice import Grid

Array = NDArray[np.float64]
SHARED = 1.6
"""Standard deviation, in range resolutions, of the Gaussian over which the sound is averaged. With
1.3 the points of nineteen touching spheres lie 0.9 mm too far out, with 2.0 0.3 mm; but with 2.0
two spheres that stand close are joined."""
COMPRESSION = 0.25
"""Exponent of the power that a point weighs: quiet parts must count beside loud ones."""
_FAINTEST = 1e-4  # fraction of a pose's greatest power; quieter sound is left out, to save time
_BANDS = 5  # frequencies, evenly spread, whose power is averaged
_CUTOFF = 2.5  # standard deviations after which the Gaussian is cut off


@dataclass(frozen=True, eq=False)
class Evidence:
    """Points of a surface as poses hear them.

    Attributes:
        points ((G, 3), m): World frame.
        normals (G, 3): Unit vectors towards the poses.
        weight (G,): Compressed power of the echo without spreading; at most 1, which half of the
            poses reach with the loudest that they hear.
        pose (G,): Which pose hears it.
    """

    points: Array
    normals: Array
    weight: Array
    pose: NDArray[np.intp]

    def where(self, kept: NDArray[np.bool_]) -> Evidence:
        """Return those for which (G,) is true."""
        return Evidence(self.points[kept], self.normals[kept], self.weight[kept], self.pose[kept])


@torch.no_grad()
def locate_sound(
    field: Field,
    places: Tensor,
    sources: Array,
    *,
    resolution: float,
    progress: Callable[[int, int], None] | None = None,
) -> Evidence:
    """Listen to a field from where it was heard, and put its sound at its ranges.

    Args:
        field: What was fitted.
        places ((N, 3), m): Where it is not silent.
        sources ((P, 3), m): Half way between emitter and ears of each pose.
        resolution (m): Range resolution; points of one pose in one cube of this side become one.
        progress: Called with the poses done and the poses in all.

    Returns:
        evidence: Empty where nothing is heard.
    """
    bands = torch.arange(_BANDS, device=places.device) * (len(field.frequency) - 1) // (_BANDS - 1)
    where = places.cpu().double().numpy()
    kernel = _neighbours(where, SHARED * resolution)
    found: list[tuple[Array, Array, Array, NDArray[np.intp]]] = []
    for pose, source in enumerate(sources):
        emitter = torch.as_tensor(source, dtype=places.dtype, device=places.device)
        ray = emitter - places
        distance = ray.norm(dim=-1)
        index = field.audible(places, emitter[None])[0].nonzero()[:, 0]
        unit = ray[index] / distance[index, None]
        response, lead = field.echo(places[index], unit, bands)
        # The power at the pose decides what is heard; without spreading it is what there is.
        power = response.abs().square().mean(-1)
        heard = power / distance[index] ** 4
        loud = heard > _FAINTEST * heard.max() if len(heard) else heard > 0
        if bool(loud.any()):
            index = index[loud]
            range_ = (distance[index] - lead[loud]).cpu().double().numpy()
            which = index.cpu().numpy()
            near = kernel[which][:, which]
            sound = power[loud].cpu().double().numpy()
            located = _moved(where[which], range_, sound, near, source, resolution)
            found.append((*located, np.full(len(located[0]), pose, dtype=np.intp)))
        if progress is not None:
            progress(pose + 1, len(sources))
    if not found:
        return Evidence(np.zeros((0, 3)), np.zeros((0, 3)), np.zeros(0), np.zeros(0, np.intp))
    points, normals, power_ = (np.concatenate([f[k] for f in found]) for k in range(3))
    pose_ = np.concatenate([f[3] for f in found])
    usual = float(np.median([f[2].max() for f in found]))
    weight = np.minimum(power_ / usual, 1.0) ** COMPRESSION
    return Evidence(points, normals, weight, pose_)


def _neighbours(places: Array, deviation: float) -> sparse.csr_matrix:
    """Return the Gaussian weights of places close to each other, (N, N)."""
    tree = cKDTree(places)
    pairs = tree.sparse_distance_matrix(tree, _CUTOFF * deviation, output_type="ndarray")
    weight = np.exp(-0.5 * (pairs["v"] / deviation) ** 2)
    return sparse.csr_matrix((weight, (pairs["i"], pairs["j"])), shape=(len(places),) * 2)


def _moved(
    places: Array,
    ranges: Array,
    power: Array,
    near: sparse.csr_matrix,
    source: Array,
    side: float,
) -> tuple[Array, Array, Array]:
    """Return points, normals and power of one pose's sound, one per cube."""
    summed = near @ np.column_stack((power, power[:, None] * places, power * ranges))
    middle = summed[:, 1:4] / summed[:, :1]
    at = summed[:, 4] / summed[:, 0]
    towards = source - middle
    towards /= np.linalg.norm(towards, axis=1, keepdims=True)
    points = source - at[:, None] * towards
    cube = np.floor((points - points.min(axis=0)) / side).astype(np.int64)
    size = cube.max(axis=0) + 1
    flat = (cube[:, 0] * size[1] + cube[:, 1]) * size[2] + cube[:, 2]
    _, member = np.unique(flat, return_inverse=True)
    total = np.bincount(member, power)
    points = np.column_stack([np.bincount(member, power * p) for p in points.T]) / total[:, None]
    towards = source - points
    normals: Array = towards / np.linalg.norm(towards, axis=1, keepdims=True)
    return points, normals, np.asarray(total, dtype=np.float64)


_ROBUST = 1.5  # voxels, scale of Cauchy's loss: evidence farther off the surface hardly counts
_OUTER, _INNER = 4, 40  # rounds of reweighting, steps of conjugate gradients in each
_COARSEST = 12  # least voxels along an axis of the coarsest grid
_ACCURACY = 1e-3  # of the residual's norm, where conjugate gradients stop


def signed_distance(
    weight: Grid, target: Grid, bound: Grid, pull: float, empty: Grid, bending: float
) -> Grid:
    """Return the signed distance, positive outside.

    Args:
        weight (X, Y, Z): Of the targets, from 0 to 1.
        target ((X, Y, Z), voxels): Signed distance by the evidence.
        bound ((X, Y, Z), voxels): What the distance must not lie below.
        pull: Weight of the distance to the bound.
        empty (X, Y, Z): Weight with which a place is outside.
        bending: Weight of the squared Laplacian.

    Returns:
        distance: (X, Y, Z), voxels.
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
