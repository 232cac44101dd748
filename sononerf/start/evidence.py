# SPDX-License-Identifier: MIT
"""Oriented evidence: places on its lines of sight from which each pose hears the field.

The fit brings the *sound* of a field to its range within a tenth of a millimetre. The places of the
field may lie elsewhere, because places closer than the range resolution share one echo. So each
place is moved to the mean range of the sound around it, on the line of sight through the mean of
that sound. The result is a point of the surface whose normal looks at the pose.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
import torch
import trimesh
from numpy.typing import NDArray
from scipy import ndimage, sparse
from scipy.spatial import cKDTree
from torch import Tensor

from sononerf.echoes.free_space import EchoHull
from sononerf.field.field import Field
from sononerf.numerics import Bools, Floats, Ints, Singles

AVERAGING_WIDTH = 1.6
"""Standard deviation, in range resolutions, of the Gaussian over which the sound is averaged. With
1.3 the points of nineteen touching spheres lie 0.9 mm too far out, with 2.0 0.3 mm; but with 2.0
two spheres that stand close are joined."""
MAX_PAIRS = 1e8
"""Pairs of neighbouring places, at most, over which the sound is averaged: 5 GB of memory. Three
spheres have 1e6. Of more places a random part is taken."""
COMPRESSION = 0.25
"""Exponent of the power in the weight of a point: quiet parts must count beside loud ones."""
_FAINTEST = 1e-4  # fraction of a pose's greatest power; quieter sound is left out, to save time
_BANDS = 5  # frequencies, evenly spread, whose power is averaged
_CUTOFF = 2.5  # standard deviations after which the Gaussian is cut off


@dataclass(frozen=True, eq=False)
class Evidence:
    """Points of a surface as poses hear them."""

    points: Floats  # (G, 3), m: World frame
    normals: Floats  # (G, 3): Unit vectors towards the poses
    # (G,): Compressed power of the echo without spreading, at most 1; the loudest point of half of
    # the poses reaches 1
    weight: Floats
    pose: NDArray[np.intp]  # (G,): Index of the pose that hears it

    def where(self, kept: Bools | Ints) -> Evidence:
        """Return those for which (G,) is true, or those of some indices."""
        return Evidence(self.points[kept], self.normals[kept], self.weight[kept], self.pose[kept])


@torch.no_grad()
def locate_sound(
    field: Field,
    places: Tensor,
    sources: Floats,
    *,
    resolution: float,
    progress: Callable[[int, int], None] | None = None,
) -> Evidence:
    """Return the places from which poses hear a field, as points at the ranges of its sound.

    In: places ((N, 3), m), sources ((P, 3), m), resolution (m).
    """
    bands = torch.arange(_BANDS, device=places.device) * (len(field.frequency) - 1) // (_BANDS - 1)
    where = places.cpu().double().numpy()
    kept = _bounded(where, AVERAGING_WIDTH * resolution)
    places, where = places[torch.as_tensor(kept, device=places.device)], where[kept]
    kernel = _neighbours(where, AVERAGING_WIDTH * resolution)
    parts: list[tuple[Floats, Floats, Floats, NDArray[np.intp]]] = []
    for pose, source in enumerate(sources):
        emitter = torch.as_tensor(source, dtype=places.dtype, device=places.device)
        ray = emitter - places
        distance = ray.norm(dim=-1)
        index = field.audible(places, emitter[None])[0].nonzero()[:, 0]
        unit = ray[index] / distance[index, None]
        response, lead = field.echo(places[index], unit, bands)
        # The power at the pose decides which places are heard; the power without spreading is their
        # weight.
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
            parts.append((*located, np.full(len(located[0]), pose, dtype=np.intp)))
        if progress is not None:
            progress(pose + 1, len(sources))
    if not parts:
        return Evidence(np.zeros((0, 3)), np.zeros((0, 3)), np.zeros(0), np.zeros(0, np.intp))
    points, normals, power_ = (np.concatenate([f[k] for f in parts]) for k in range(3))
    pose_ = np.concatenate([f[3] for f in parts])
    usual = float(np.median([f[2].max() for f in parts]))
    weight = np.minimum(power_ / usual, 1.0) ** COMPRESSION
    return Evidence(points, normals, weight, pose_)


def _bounded(places: Floats, deviation: float) -> Ints:
    """Return the places whose pairs of neighbours fit into memory: all, or a random part."""
    tree = cKDTree(places)
    pairs = float(tree.count_neighbors(tree, _CUTOFF * deviation))
    count = int(len(places) * min(1.0, np.sqrt(MAX_PAIRS / max(pairs, 1.0))))
    return np.sort(np.random.default_rng(0).choice(len(places), count, replace=False))


def _neighbours(places: Floats, deviation: float) -> sparse.csr_matrix:
    """Return the Gaussian weights of places close to each other, (N, N)."""
    tree = cKDTree(places)
    pairs = tree.sparse_distance_matrix(tree, _CUTOFF * deviation, output_type="ndarray")
    weight = np.exp(-0.5 * (pairs["v"] / deviation) ** 2)
    return sparse.csr_matrix((weight, (pairs["i"], pairs["j"])), shape=(len(places),) * 2)


def _moved(
    places: Floats,
    ranges: Floats,
    power: Floats,
    near: sparse.csr_matrix,
    source: Floats,
    side: float,
) -> tuple[Floats, Floats, Floats]:
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
    normals: Floats = towards / np.linalg.norm(towards, axis=1, keepdims=True)
    return points, normals, np.asarray(total, dtype=np.float64)


_ROBUST = 1.5  # voxels, scale of Cauchy's loss: evidence farther off the surface hardly counts
_OUTER, _INNER = 4, 40  # rounds of reweighting, steps of conjugate gradients in each
_COARSEST = 12  # least voxels along an axis of the coarsest grid
_ACCURACY = 1e-3  # relative residual at which conjugate gradients stop


def fitted_distance(
    weight: Singles, target: Singles, bound: Singles, pull: float, empty: Singles, bending: float
) -> Singles:
    """Return the signed distance, positive outside.

    In: weight (X, Y, Z), target ((X, Y, Z), voxels), bound ((X, Y, Z), voxels), empty (X, Y, Z).
    Out: (X, Y, Z).
    """
    if min(weight.shape) >= 2 * _COARSEST:
        coarse = _halved(weight)
        moment = _halved(np.asarray(weight * target, dtype=np.float32))
        aim: Singles = (moment / np.maximum(coarse, 1e-9)).astype(np.float32)
        # Values stay in fine voxels, so a Laplacian on twice the spacing is four times as small.
        first = fitted_distance(coarse, aim, _halved(bound), pull, _halved(empty), bending / 16)
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


def _halved(grid: Singles) -> Singles:
    """Average blocks of eight; an odd last layer counts twice."""
    padded = np.pad(grid, [(0, n % 2) for n in grid.shape], mode="edge")
    x, y, z = (n // 2 for n in padded.shape)
    return np.asarray(padded.reshape(x, 2, y, 2, z, 2).mean(axis=(1, 3, 5)), dtype=np.float32)


def _laplacian(values: Singles) -> Singles:
    result = np.zeros_like(values)
    for axis in range(3):
        step = np.diff(values, axis=axis)
        before = tuple(slice(None, -1) if a == axis else slice(None) for a in range(3))
        behind = tuple(slice(1, None) if a == axis else slice(None) for a in range(3))
        result[before] += step
        result[behind] -= step
    return result


def _conjugate_gradients(
    x: Singles, diagonal: Singles, right: Singles, bending: float, steps: int
) -> Singles:
    """Solve (diagonal + bending Laplacian²) x = right, from x on."""

    def product(v: Singles) -> Singles:
        return np.asarray(diagonal * v + bending * _laplacian(_laplacian(v)), dtype=np.float32)

    scale = 1 / (diagonal + np.float32(42 * bending))  # 42: on the diagonal of Laplacian²
    x = x.copy()
    residual = right - product(x)
    search = scale * residual
    size = first = float((residual * search).sum())
    for _ in range(steps):
        if not size > _ACCURACY**2 * first:
            break
        image = product(search)
        length = np.float32(size / float((search * image).sum()))
        x += length * search
        residual -= length * image
        scaled = scale * residual
        before, size = size, float((residual * scaled).sum())
        search = scaled + np.float32(size / before) * search
    return x


NEIGHBOUR_RADIUS = 2.0
"""Distance from a point within which others are compared with it, range resolutions."""
ALIGNED = 0.3
"""Distance that two points may lie off one smooth surface, range resolutions; also the standard
deviation of the distance between a pose's onset and its evidence."""
HALF_RELIABLE_POWER = 0.3
"""Power of agreeing points over the mean power at which the reliability is halved."""
AT_ONSET = 0.7
"""Reliability of a point at the onset of its own pose."""
_WITNESSES = 4000  # largest number of points that are compared; it bounds the time
_CHUNK = 4000  # points at a time; it bounds the memory


def reliability(evidence: Evidence, hull: EchoHull, resolution: float) -> Floats:
    """Return the reliability of each point, (G,) from 0 to 1.

    Several poses hear sound from one smooth surface, and the first sound of a pose comes from the
    point nearest to it. Later bounces and results of interference appear at other places for each
    pose.

    In: resolution (m).
    """
    if not len(evidence.points):
        return np.zeros(0)
    by_others = _agreement(evidence, resolution)
    own = np.concatenate(
        [
            hull.behind(evidence.points[i : i + _CHUNK])[
                np.arange(len(evidence.points[i : i + _CHUNK])), evidence.pose[i : i + _CHUNK]
            ].min(axis=1)
            for i in range(0, len(evidence.points), _CHUNK)
        ]
    )
    at_onset = AT_ONSET * np.exp(-0.5 * (own / (ALIGNED * resolution)) ** 2)
    return np.maximum(by_others, at_onset)


def _agreement(evidence: Evidence, resolution: float) -> Floats:
    """Return the fraction of the surrounding power on one smooth surface, if it is enough."""
    points, normals = evidence.points, evidence.normals
    count = len(points)
    # Evenly over all poses: points come pose by pose.
    witnesses = np.unique(np.linspace(0, count - 1, min(count, _WITNESSES)).astype(np.intp))
    pairs = cKDTree(points).sparse_distance_matrix(
        cKDTree(points[witnesses]), NEIGHBOUR_RADIUS * resolution, output_type="ndarray"
    )
    i, j = pairs["i"], witnesses[pairs["j"]]
    other = evidence.pose[i] != evidence.pose[j]
    i, j = i[other], j[other]
    # Between two points of one sphere the chord is at right angles to the sum of their normals.
    chord = np.einsum("nd,nd->n", points[j] - points[i], normals[i] + normals[j])
    alike = np.einsum("nd,nd->n", normals[i], normals[j]) > 0.5
    agrees = alike & (np.abs(chord) < 2 * ALIGNED * resolution)
    power = evidence.weight ** (1 / COMPRESSION)
    support = np.bincount(i, power[j] * agrees, count)
    around = np.bincount(i, power[j], count) + power
    usual = float(np.average(support, weights=power))
    if not usual > 0:
        return np.zeros(count)
    return support / around * support / (support + HALF_RELIABLE_POWER * usual)


_ALIKE = 0.5  # cosine of the greatest angle between the normals of a vertex and of a point
_PAIRS = 2_000_000  # vertices times points at a time; it bounds the memory


def poses_that_heard(
    mesh: trimesh.Trimesh, evidence: Evidence, resolution: float
) -> NDArray[np.int32]:
    """Count the poses that heard the surface around each vertex.

    A pose counts where a point of its evidence lies within two range resolutions of the vertex,
    looks the same way within 60 degrees, and lies on one smooth surface with it.

    In: resolution (m). Out: (V,).
    """
    counts = np.zeros(len(mesh.vertices), np.int32)
    if not len(evidence.points):
        return counts
    vertices, normals = np.asarray(mesh.vertices), np.asarray(mesh.vertex_normals)
    tree = cKDTree(evidence.points)
    chunk = max(1, _PAIRS // len(evidence.points))
    # Neighbours together, so that few points are near each chunk.
    order = cKDTree(vertices).indices
    poses = evidence.pose.max() + 1
    for start in range(0, len(order), chunk):
        some = order[start : start + chunk]
        pairs = cKDTree(vertices[some]).sparse_distance_matrix(
            tree, NEIGHBOUR_RADIUS * resolution, output_type="ndarray"
        )
        i, j = pairs["i"], pairs["j"]
        ours, theirs = normals[some[i]], evidence.normals[j]
        alike = np.einsum("nd,nd->n", ours, theirs) > _ALIKE
        between = evidence.points[j] - vertices[some[i]]
        off = np.abs(np.einsum("nd,nd->n", between, ours + theirs))
        agrees = alike & (off < 2 * ALIGNED * resolution)
        pose = evidence.pose[j[agrees]].astype(np.int64)
        both = np.unique(i[agrees].astype(np.int64) * poses + pose)
        counts[some] = np.bincount(both // poses, minlength=len(some))
    return counts
