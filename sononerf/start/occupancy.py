# SPDX-License-Identifier: MIT
"""Occupancy: the body's place from onsets and fitted field, and its surface.

Three kinds of evidence enter one signed distance, see :mod:`sononerf.start.evidence`:

- *oriented points*: the field's sound, put at its range on the line of sight of each pose, weighted
  by how well other poses and the onsets agree with it;
- *free space*: places in front of an onset are empty, and with no other evidence the body reaches
  as far as the onsets let it;
- *winding number*: where that of the oriented points is negative, mostly backs of surfaces are
  seen. Such a place is outside, even if the onsets allow a body there (a hollow, a gap).

Few poses face a flat side, so the winding number may be wrong about it; and a field that is fitted
badly is wrong everywhere. How much weight this has is the ``StartMode``; the caller chooses it by
what explains the echoes.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Literal

import numpy as np
import torch
import trimesh
from scipy import fft, ndimage

from sononerf.echoes.free_space import EchoHull
from sononerf.errors import NumericalError
from sononerf.field.field import Field
from sononerf.geometry.lattice import MARGIN, Lattice, level_surface
from sononerf.numerics import Floats, Singles
from sononerf.start.evidence import Evidence, fitted_distance, locate_sound, reliability

_DENSE = 0.2  # density, over the median at the points, at which a plane has half of its full weight
_PLANE = 1.0  # voxels, standard deviation of the Gaussian over which a point's plane counts
_LOCAL = 3.0  # voxels over which the density of points is measured
_BLUR = 1.5  # voxels over which normals are averaged to find out where opposite ones cancel


def thinness(lattice: Lattice, points: Floats, normals: Floats, weight: Floats) -> Singles:
    """Return where the body is so thin that its two sides would cancel, from 0 to 1.

    At such places the blurred normals are short relative to the blurred weights, or are reversed
    behind a point. In a narrow gap they are reversed in front of it.

    In: points, normals (G, 3), weight (G,). Out: (X, Y, Z).
    """
    if not len(points):
        return np.zeros(lattice.shape, np.float32)
    total = lattice.spread(points, weight, _BLUR)
    blurred = [lattice.spread(points, weight * along, _BLUR) for along in normals.T]

    def agreement(shift: float) -> Floats:
        where = points + shift * lattice.spacing * normals
        along = sum(
            n * lattice.read(grid, where) for n, grid in zip(normals.T, blurred, strict=True)
        )
        return np.asarray(along / np.maximum(lattice.read(total, where), 1e-12))

    here, behind, before = agreement(0.0), agreement(-2.0), agreement(2.0)
    # One smooth side alone agrees by more than 0.6 with its mean normal; two sides by less.
    cancels = ((0.6 - here) / 0.4).clip(0, 1) * (before >= behind)
    backed = ((-behind - 0.2) / 0.4).clip(0, 1)
    wide = lattice.spread(points, weight, 2.0)
    thin = lattice.spread(points, weight * np.maximum(cancels, backed), 2.0)
    return np.asarray(thin / np.maximum(wide, 1e-3 * wide.max() + 1e-30), dtype=np.float32)


def planes(
    lattice: Lattice, points: Floats, normals: Floats, weight: Floats
) -> tuple[Singles, Singles]:
    """Return the weight of the evidence at voxels near points, and their distance to its planes.

    In: points, normals (G, 3), weight (G,). Out: known (X, Y, Z), target ((X, Y, Z), voxels).
    """
    size = int(np.prod(lattice.shape))
    total, moment = np.zeros(size), np.zeros(size)
    place = lattice.coordinates(points)
    nearest = np.rint(place).astype(np.intp)
    for step in np.ndindex(5, 5, 5):
        voxel = nearest + np.asarray(step) - 2
        off = voxel - place
        within = ((voxel >= 0) & (voxel < np.asarray(lattice.shape))).all(axis=1)
        near = weight * np.exp(-0.5 * (off**2).sum(axis=1) / _PLANE**2)
        flat = np.ravel_multi_index(tuple(voxel[within].T), lattice.shape)
        total += np.bincount(flat, near[within], size)
        moment += np.bincount(flat, (near * (off * normals).sum(axis=1))[within], size)
    target = (moment / np.maximum(total, 1e-12)).reshape(lattice.shape).astype(np.float32)
    known = total.reshape(lattice.shape)
    if len(points):
        known /= known + _DENSE * np.median(lattice.read(known, points)) + 1e-30
    return known.astype(np.float32), target


def winding_of(lattice: Lattice, points: Floats, normals: Floats, weight: Floats) -> Singles:
    """Return the winding number of oriented points; each part of the surface counts once.

    In: points, normals (G, 3), weight (G,). Out: winding (X, Y, Z), about 1 inside of a body, 0
    outside, negative behind backs.
    """
    around = lattice.spread(points, weight, _LOCAL)
    # A plane of density 1 has this value at its points when it is blurred.
    unit = np.sqrt(2 * np.pi) * _LOCAL
    level = unit * (around + 0.05 * np.median(lattice.read(around, points)))
    flux = [
        lattice.spread(points, weight * along, 1.0) / level.astype(np.float32)
        for along in normals.T
    ]
    return np.asarray(ndimage.gaussian_filter(winding_number(flux), 1.0), dtype=np.float32)


_AIR = 0.25  # fraction of the longest side, empty on each side: periodic images must stay apart


def winding_number(flux: Sequence[Singles]) -> Singles:
    """Return the winding number of a density of surface.

    In: flux (three (X, Y, Z) float, 1/voxel). Out: winding (X, Y, Z).
    """
    shape = flux[0].shape
    air = 2 * round(_AIR * max(shape))
    size = [int(fft.next_fast_len(n + air, real=True)) for n in shape]
    square = np.zeros(1, np.float32)
    total = np.zeros(1, np.complex64)
    for axis, n in enumerate(size):
        frequency = np.fft.rfftfreq(n) if axis == 2 else np.fft.fftfreq(n)
        wave = (2 * np.pi * frequency).astype(np.float32)
        wave = wave.reshape([-1 if a == axis else 1 for a in range(3)])
        square = square + wave**2
        total = total + wave * fft.rfftn(flux[axis], s=size)
    square[0, 0, 0] = 1.0  # the mean is set below
    number = fft.irfftn(1j * total / square, s=size)
    far = [
        number.take((inner + whole) // 2, axis).mean()
        for axis, (inner, whole) in enumerate(zip(shape, size, strict=True))
    ]
    x, y, z = shape
    return np.asarray(number[:x, :y, :z] - np.mean(far), dtype=np.float32)


StartMode = Literal["open", "filled", "hull"]
"""Weight of the field's sound beside the onsets. ``open``: the winding number opens hollows and
gaps that the onsets leave closed. ``filled``: it does not. ``hull``: the onsets alone give the
surface, which
is exact for a convex body."""
MIN_EVIDENCE = 0.12
"""Weight below which evidence is left out, no unit: -37 dB relative to the loudest of a usual pose.
The fit places most quieter sound at random."""
SPAN = {"open": 2.4, "filled": 1.0}
"""Length over which oriented points outweigh the onsets' bound, range resolutions, by mode.
Over a wider gap the bound stays, unless the winding number opens it."""
BACKS = (0.02, 0.06)
"""Negative winding number from which a place counts as outside, and the interval over which its
weight rises to the maximum."""
OPENING = 0.03
"""Weight of a place that is outside by its winding number; evidence has weight 1 at its point."""
THICKENING = 1.5
"""Length that each side of a thin part is moved outward, and the surface moved back, voxels: two
sides closer than the blur of their planes would cancel."""
MIN_PART_EVIDENCE = 0.03
"""Evidence of a part per area, over that of the part with most evidence, below which the part is
left out."""
_BENDING = 1.0  # of a voxel; evidence at its point has 1: it sets the unit of all weights
_NEGLIGIBLE = 1e-3  # weight of a point that is left out of the planes, to save time
_LEAST = 30  # voxels of the smallest surface
_RESOLVED = 8  # voxels of the smallest part
_CONTRADICTED = 4.0  # range resolutions; if all places lie farther in front, onsets are wrong


@dataclass(frozen=True, eq=False)
class Gathered:
    """All evidence, on one lattice; a surface of it is found by :func:`estimate_occupancy`."""

    evidence: Evidence  # The oriented points
    # (G,): Weights of the points, from 0 to 1: their own weight times their reliability
    weight: Floats
    # (G, 3), m: Places of the points on the lattice, moved outward where the body is thin
    points: Floats
    lattice: Lattice  # The voxels
    thin: Singles  # (X, Y, Z): Thinness of the body, from 0 to 1
    # (X, Y, Z), voxels: Signed distance of the boundary of free space; no body lies below it
    bound: Singles
    hull: EchoHull  # The free space
    resolution: float  # m: Range resolution
    _distances: dict[str, Singles] = field(default_factory=dict, init=False, repr=False)


def gather_evidence(
    field: Field,
    places: torch.Tensor,
    hull: EchoHull,
    lower: Floats,
    upper: Floats,
    spacing: float,
    resolution: float,
) -> Gathered:
    """Return the evidence of field and onsets about a region.

    In: places ((N, 3), m), lower, upper ((3,), m), spacing (m), resolution (m).
    """
    evidence = locate_sound(field, places, hull.sources, resolution=resolution)
    evidence = evidence.where(evidence.weight > MIN_EVIDENCE)
    if not len(evidence.points) and not np.isfinite(hull.inlier_onsets).any():
        raise NumericalError("no surface: no pose heard an echo from inside the region")
    lattice = Lattice.over(lower, upper, spacing)
    weight = evidence.weight * reliability(evidence, hull, resolution)
    thin = thinness(lattice, evidence.points, evidence.normals, weight)
    move = THICKENING * lattice.read(thin, evidence.points).clip(0, 1)
    points = evidence.points + spacing * move[:, None] * evidence.normals
    farthest = max(lattice.shape)
    bound = (-clearance_grid(hull, lattice) / spacing).clip(-farthest, farthest)
    bound = _walled(bound.astype(np.float32))
    return Gathered(evidence, weight, points, lattice, thin, bound, hull, resolution)


def estimate_occupancy(gathered: Gathered, mode: StartMode = "filled") -> trimesh.Trimesh:
    """Return the closed surface of the body, m, normals outward."""
    lattice, spacing = gathered.lattice, gathered.lattice.spacing
    if not (gathered.bound < _CONTRADICTED * gathered.resolution / spacing).any():
        raise NumericalError(
            "no surface: the first echoes leave no room for a body; check poses and speed of sound"
        )
    if mode == "hull":
        if not np.isfinite(gathered.hull.inlier_onsets).any():
            raise NumericalError("no surface: no pose has a first echo")
        distance = gathered.bound
    else:
        distance = thickened(gathered, mode)
    if not (distance < 0).any():
        # The body is thinner than a voxel: the most likely places are taken, however few.
        inner = distance[(slice(MARGIN, -MARGIN),) * 3]
        most = np.partition(inner.ravel(), min(_LEAST, inner.size - 1))[: _LEAST + 1].max()
        distance = distance - most - np.float32(0.5)
    distance = without_hollows(_walled(distance))
    distance = without_parts(distance, lattice, None if mode == "hull" else gathered)
    mesh = surface_of(distance, lattice)
    if mode != "hull":
        back = (
            THICKENING * spacing * lattice.read(gathered.thin, np.asarray(mesh.vertices)).clip(0, 1)
        )
        mesh.vertices = mesh.vertices - back[:, None] * mesh.vertex_normals
    return mesh


def thickened(gathered: Gathered, mode: Literal["open", "filled"]) -> Singles:
    """Return the signed distance by all evidence, (X, Y, Z) voxels; thin parts are too thick.

    It is too small by ``THICKENING`` times the thinness. A second call returns the same array.
    """
    if mode not in gathered._distances:
        gathered._distances[mode] = _by_all_evidence(gathered, mode)
    return gathered._distances[mode]


def _by_all_evidence(gathered: Gathered, mode: Literal["open", "filled"]) -> Singles:
    lattice, normals = gathered.lattice, gathered.evidence.normals
    bound = _walled(gathered.bound - np.float32(THICKENING) * gathered.thin)
    used = gathered.weight > _NEGLIGIBLE
    weight, target = planes(lattice, gathered.points[used], normals[used], gathered.weight[used])
    empty = np.zeros_like(bound)
    if mode == "open" and len(gathered.points):
        winding = winding_of(lattice, gathered.points, normals, gathered.evidence.weight)
        backs = (-winding - np.float32(BACKS[0])) / np.float32(BACKS[1])
        empty = np.float32(OPENING) * backs.clip(0, 1)
    span = SPAN[mode] * gathered.resolution / lattice.spacing
    return fitted_distance(weight, target, bound, span**-4, empty, _BENDING)


def _walled(distance: Singles) -> Singles:
    """Return it with air all around the region."""
    walled = np.maximum(distance, 1.0)
    inner = (slice(MARGIN - 1, 1 - MARGIN),) * 3
    walled[inner] = distance[inner]
    return walled


def without_hollows(distance: Singles) -> Singles:
    """Fill hollows of a signed distance (X, Y, Z): no sound comes out of them."""
    labels, _ = ndimage.label(distance > 0)
    hollow = (labels != labels[0, 0, 0]) & (distance > 0)
    return np.where(hollow, -distance, distance).astype(np.float32)


def without_parts(distance: Singles, lattice: Lattice, gathered: Gathered | None) -> Singles:
    """Leave out parts that the lattice does not resolve and, by the evidence, unheard ones.

    In: distance ((X, Y, Z), voxels).
    """
    labels, count = ndimage.label(distance < 0)
    if not count:
        return distance
    size = np.bincount(labels.ravel(), minlength=count + 1)[1:]
    kept, best = size >= _RESOLVED, size
    if gathered is not None:
        inside = gathered.points - 1.5 * lattice.spacing * gathered.evidence.normals
        at = np.rint(lattice.coordinates(inside)).astype(np.intp)
        at = at.clip(0, np.asarray(lattice.shape) - 1)
        heard = np.bincount(labels[tuple(at.T)], gathered.weight, count + 1)[1:]
        dense = heard / size ** (2 / 3)
        kept &= dense >= MIN_PART_EVIDENCE * dense[heard.argmax()]
        best = heard if heard.any() else size
    if not kept.any():
        kept[best.argmax()] = True
    dropped = np.concatenate(([False], ~kept))[labels]
    return np.where(dropped, np.float32(1.0), distance).astype(np.float32)


def surface_of(distance: Singles, lattice: Lattice) -> trimesh.Trimesh:
    """Return the surface of a signed distance (X, Y, Z), voxels, in m."""
    # A voxel on the surface itself would be wrapped in triangles without area.
    near = np.abs(distance) < 1e-3
    off = np.where(near, np.where(distance < 0, -1e-3, 1e-3), distance)
    return level_surface(off, 0.0, lattice.origin, lattice.spacing)


_COARSER = 4  # voxels between the places of the first look; only saves time


def clearance_grid(hull: EchoHull, lattice: Lattice) -> Floats:
    """Return the distance of each voxel behind the onsets, (X, Y, Z) m; exact near zero.

    Out: clearance ((X, Y, Z), m).
    """
    far = lattice.spacing * float(np.linalg.norm(lattice.shape))
    coarse = [np.unique(np.append(np.arange(0, n, _COARSER), n - 1)) for n in lattice.shape]
    corners = np.stack(np.meshgrid(*coarse, indexing="ij"), axis=-1).reshape(-1, 3)
    found = np.minimum(hull.clearance(lattice.origin + lattice.spacing * corners)[0], far)
    values = found.reshape([len(c) for c in coarse])
    for axis, (picked, count) in enumerate(zip(coarse, lattice.shape, strict=True)):
        at = np.interp(np.arange(count), picked, np.arange(len(picked)))
        left = np.minimum(at.astype(int), max(len(picked) - 2, 0))
        part = (at - left).reshape([-1 if a == axis else 1 for a in range(3)])
        right = np.minimum(left + 1, len(picked) - 1)
        values = values.take(left, axis) * (1 - part) + values.take(right, axis) * part
    near = np.abs(values) < _COARSER * lattice.spacing
    places = lattice.origin + lattice.spacing * np.argwhere(near)
    values[near] = np.minimum(hull.clearance(places)[0], far)
    return np.asarray(values)
