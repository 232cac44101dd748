# SPDX-License-Identifier: MIT
r"""Where the body is, for all that onsets and the fitted field tell, and its surface.

Three kinds of evidence meet in one signed distance, see :mod:`sononerf.surface.distance`:

- *oriented points*: the field's sound, put at its range on the line of sight of each pose, weighted
  by how far other poses and the onsets bear it out;
- *free space*: what lies in front of an onset is empty, and with no other evidence the body reaches
  as far as the onsets let it;
- *winding*: where the winding number of the oriented points is negative, mostly backs of surfaces
  are seen: it is outside, however far the onsets let a body reach (a hollow, a gap).

Few poses face a flat side, so sometimes the winding number is wrong about it. How far it is to be
believed is one number, ``opening``; the caller chooses it by what explains the echoes.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import torch
import trimesh
from numpy.typing import NDArray
from scipy import ndimage
from scipy.spatial import cKDTree
from skimage.measure import marching_cubes

from sononerf.echoes.free_space import EchoHull
from sononerf.errors import NumericalError
from sononerf.field.field import Field
from sononerf.surface.bounds import clearance_grid
from sononerf.surface.distance import signed_distance
from sononerf.surface.evidence import Evidence, locate_sound
from sononerf.surface.lattice import MARGIN, Grid, Lattice
from sononerf.surface.reliability import ALIGNED, REACH, reliability
from sononerf.surface.winding import winding_number

Array = NDArray[np.float64]
QUIET = 0.12
"""Weight below which evidence is left out, no unit: -37 dB beside the loudest of a usual pose.
What is quieter is mostly placed at random by the fit."""
SPAN = {"open": 2.4, "filled": 1.0}
"""Range resolutions over which oriented points outweigh the onsets' bound: a film of the bound that
is wider stays if it is not opened."""
DENSE = 0.2
"""Density of evidence, over the median at its points, from which it is fully believed."""
BACKS = (0.02, 0.06)
"""Negative winding number from which a place is taken for outside, and by how much more wholly."""
OPENING = 0.03
"""Weight of a place that is wholly outside by its winding number, beside evidence at its point."""
THICKER = 1.5
"""Voxels by which each side of a thin part is moved outward, and the surface moved back: two sides
closer than their blur would cancel."""
UNHEARD = 0.03
"""A part of which the evidence per area is this fraction of the best part's is left out."""
BENDING = 1.0  # of a voxel beside evidence at its point; sets the unit of all weights
_NEGLIGIBLE = 1e-3  # weight of a point that is left out of the planes, to save time
_SMEAR = 1.0  # voxels, of a point's plane
_LEAST = 30  # voxels of the smallest surface
_CONTRADICTED = 4.0  # range resolutions by which every place lies in front of an onset
_LOCAL = 3.0  # voxels over which the density of points is measured
_CHUNK = 100_000


@dataclass(frozen=True, eq=False)
class Occupancy:
    """A body, its surface, and what bears it out.

    Attributes
    ----------
    mesh : Trimesh
        Closed, m, normals outward.
    support : (V,) int32
        How many poses heard the surface around each vertex.
    distance : (X, Y, Z) float, m
        Signed distance, positive outside.
    lattice : Lattice
        Its voxels.
    evidence : Evidence
        The oriented points.
    hull : EchoHull
        The free space.
    """

    mesh: trimesh.Trimesh
    support: NDArray[np.int32]
    distance: Grid
    lattice: Lattice
    evidence: Evidence
    hull: EchoHull

    def possible(self, points: Array, tolerance: float) -> NDArray[np.bool_]:
        """Return whether something may be at places (N, 3), m.

        Parameters
        ----------
        points : (N, 3) float, m
            World frame.
        tolerance : float, m
            How far a place speaks for its surroundings.
        """
        near = self.lattice.read(self.distance, points) <= tolerance + self.lattice.spacing
        return np.asarray(near & (self.hull.clearance(points)[0] >= -tolerance))


@dataclass(frozen=True, eq=False)
class Gathered:
    """All evidence, on one lattice; a surface of it is found by :func:`estimate_occupancy`.

    Attributes
    ----------
    evidence : Evidence
        The oriented points.
    believed : (G,) float
        Their weights, from 0 to 1.
    points : (G, 3) float, m
        Where they stand on the lattice: moved outward where the body is thin.
    lattice : Lattice
        The voxels.
    thin : (X, Y, Z) float
        How far the body is thin, from 0 to 1.
    bound : (X, Y, Z) float, voxels
        What the signed distance must not lie below.
    hull : EchoHull
        The free space.
    resolution : float, m
        Range resolution.
    """

    evidence: Evidence
    believed: Array
    points: Array
    lattice: Lattice
    thin: Grid
    bound: Grid
    hull: EchoHull
    resolution: float


def gather_evidence(
    field: Field,
    places: torch.Tensor,
    hull: EchoHull,
    lower: Array,
    upper: Array,
    spacing: float,
    resolution: float,
) -> Gathered:
    """Return what the field and the onsets tell about a region.

    Parameters
    ----------
    field : Field
        What was fitted.
    places : (N, 3) float, m
        Where it is not silent.
    hull : EchoHull
        Free space in front of the onsets.
    lower, upper : (3,) float, m
        The region.
    spacing : float, m
        Of the voxels.
    resolution : float, m
        Range resolution of the analysis.

    Raises
    ------
    NumericalError
        If nothing was heard.
    """
    evidence = locate_sound(field, places, hull.sources, resolution=resolution)
    evidence = evidence.where(evidence.weight > QUIET)
    if not len(evidence.points) and not np.isfinite(hull.trusted).any():
        raise NumericalError("no surface: no pose heard an echo from inside the region")
    lattice = Lattice.over(lower, upper, spacing)
    believed = evidence.weight * reliability(evidence, hull, resolution)
    thin = _thinness(lattice, evidence, believed)
    move = THICKER * lattice.read(thin, evidence.points).clip(0, 1)
    points = evidence.points + spacing * move[:, None] * evidence.normals
    farthest = max(lattice.shape)
    bound = (-clearance_grid(hull, lattice) / spacing).clip(-farthest, farthest)
    bound = _walled((bound - THICKER * thin).astype(np.float32))
    return Gathered(evidence, believed, points, lattice, thin, bound, hull, resolution)


def estimate_occupancy(known: Gathered, *, opening: bool = True) -> Occupancy:
    """Return where the body is.

    Parameters
    ----------
    known : Gathered
        The evidence.
    opening : bool
        Whether the winding number opens hollows and gaps that the onsets leave closed. Without
        it the onsets outweigh the field's sound over shorter gaps, too.

    Raises
    ------
    NumericalError
        If the onsets contradict one another: no place is left by nearly all of them.
    """
    lattice, evidence, points = known.lattice, known.evidence, known.points
    spacing, thin = lattice.spacing, known.thin
    told = known.believed > _NEGLIGIBLE
    weight, target = _planes(lattice, points[told], evidence.normals[told], known.believed[told])
    empty = np.zeros_like(known.bound)
    if opening and len(points):
        backs = -_winding(lattice, points, evidence) - np.float32(BACKS[0])
        empty = np.float32(OPENING) * (backs / np.float32(BACKS[1])).clip(0, 1)
    if not (known.bound < _CONTRADICTED * known.resolution / spacing).any():
        raise NumericalError(
            "no surface: the first echoes leave no room for a body; check poses and speed of sound"
        )
    span = SPAN["open" if opening else "filled"] * known.resolution / spacing
    distance = signed_distance(weight, target, known.bound, span**-4, empty, BENDING)
    if not (distance < 0).any():
        # What was heard is thinner than a voxel: the most likely places are taken, however little.
        inner = distance[(slice(MARGIN, -MARGIN),) * 3]
        most = np.partition(inner.ravel(), min(_LEAST, inner.size - 1))[: _LEAST + 1].max()
        distance = distance - most - np.float32(0.5)
    distance = _cleaned(_walled(distance), lattice, points, evidence.normals, known.believed)
    mesh = _surface(distance, lattice)
    back = THICKER * spacing * lattice.read(thin, np.asarray(mesh.vertices)).clip(0, 1)
    mesh.vertices = mesh.vertices - back[:, None] * mesh.vertex_normals
    support = poses_that_heard(mesh, evidence, known.resolution)
    return Occupancy(mesh, support, spacing * distance, lattice, evidence, known.hull)


def _thinness(lattice: Lattice, evidence: Evidence, weight: Array) -> Grid:
    """Return where the other side is so close that both would cancel, from 0 to 1.

    There the blurred normals are short beside the blurred weights, or point the other way behind a
    point. In a narrow gap they do so in front of it.
    """
    if not len(evidence.points):
        return np.zeros(lattice.shape, np.float32)
    total = lattice.spread(evidence.points, weight, 1.5)
    blurred = [lattice.spread(evidence.points, weight * along, 1.5) for along in evidence.normals.T]

    def agreement(shift: float) -> Array:
        where = evidence.points + shift * lattice.spacing * evidence.normals
        along = sum(
            n * lattice.read(grid, where)
            for n, grid in zip(evidence.normals.T, blurred, strict=True)
        )
        return np.asarray(along / np.maximum(lattice.read(total, where), 1e-12))

    here, behind, before = agreement(0.0), agreement(-2.0), agreement(2.0)
    cancels = ((0.6 - here) / 0.4).clip(0, 1) * (before >= behind)
    backed = ((-behind - 0.2) / 0.4).clip(0, 1)
    wide = lattice.spread(evidence.points, weight, 2.0)
    thin = lattice.spread(evidence.points, weight * np.maximum(cancels, backed), 2.0)
    return np.asarray(thin / np.maximum(wide, 1e-3 * wide.max() + 1e-30), dtype=np.float32)


def _planes(lattice: Lattice, points: Array, normals: Array, weight: Array) -> tuple[Grid, Grid]:
    """Return how far voxels near points are known, 0 to 1, and their distance to the planes."""
    size = int(np.prod(lattice.shape))
    total, moment = np.zeros(size), np.zeros(size)
    place = lattice.coordinates(points)
    nearest = np.rint(place).astype(np.intp)
    for step in np.ndindex(5, 5, 5):
        voxel = nearest + np.asarray(step) - 2
        off = voxel - place
        within = ((voxel >= 0) & (voxel < np.asarray(lattice.shape))).all(axis=1)
        near = weight * np.exp(-0.5 * (off**2).sum(axis=1) / _SMEAR**2)
        flat = np.ravel_multi_index(tuple(voxel[within].T), lattice.shape)
        total += np.bincount(flat, near[within], size)
        moment += np.bincount(flat, (near * (off * normals).sum(axis=1))[within], size)
    target = (moment / np.maximum(total, 1e-12)).reshape(lattice.shape).astype(np.float32)
    known = total.reshape(lattice.shape)
    if len(points):
        known /= known + DENSE * np.median(lattice.read(known, points)) + 1e-30
    return known.astype(np.float32), target


def _winding(lattice: Lattice, points: Array, evidence: Evidence) -> Grid:
    """Return the winding number of the evidence, each place of the surface counted once."""
    around = lattice.spread(points, evidence.weight, _LOCAL)
    # A plane of density 1 has this value at its points when it is blurred.
    unit = np.sqrt(2 * np.pi) * _LOCAL
    level = unit * (around + 0.05 * np.median(lattice.read(around, points)))
    flux = [
        lattice.spread(points, evidence.weight * along, 1.0) / level.astype(np.float32)
        for along in evidence.normals.T
    ]
    return np.asarray(ndimage.gaussian_filter(winding_number(flux), 1.0), dtype=np.float32)


def _walled(distance: Grid) -> Grid:
    """Return it with air all around the region."""
    walled = np.maximum(distance, 1.0)
    inner = (slice(MARGIN - 1, 1 - MARGIN),) * 3
    walled[inner] = distance[inner]
    return walled


def _cleaned(
    distance: Grid, lattice: Lattice, points: Array, normals: Array, weight: Array
) -> Grid:
    """Fill hollows, from which no sound comes, and leave out parts that hardly any sound backs."""
    labels, _ = ndimage.label(distance > 0)
    distance = np.where((labels != labels[0, 0, 0]) & (distance > 0), -distance, distance)
    labels, count = ndimage.label(distance < 0)
    if not count:
        return distance
    size = np.bincount(labels.ravel(), minlength=count + 1)
    at = np.rint(lattice.coordinates(points - 1.5 * lattice.spacing * normals)).astype(np.intp)
    at = at.clip(0, np.asarray(lattice.shape) - 1)
    backing = np.bincount(labels[tuple(at.T)], weight, count + 1)[1:]
    dense = backing / size[1:] ** (2 / 3)
    kept = (dense >= UNHEARD * dense.max()) & (size[1:] >= 8)
    if not kept.any():
        kept[(backing if backing.any() else size[1:]).argmax()] = True
    dropped = np.concatenate(([False], ~kept))[labels]
    return np.where(dropped, np.float32(1.0), distance).astype(np.float32)


def _surface(distance: Grid, lattice: Lattice) -> trimesh.Trimesh:
    # A voxel on the surface itself would be wrapped in triangles without area.
    near = np.abs(distance) < 1e-3
    off = np.where(near, np.where(distance < 0, -1e-3, 1e-3), distance)
    vertices, faces, _, _ = marching_cubes(
        off.astype(np.float32), 0.0, gradient_direction="ascent", allow_degenerate=False
    )
    vertices = lattice.origin + lattice.spacing * np.asarray(vertices, dtype=np.float64)
    mesh = trimesh.Trimesh(vertices, faces, process=False)
    if mesh.volume < 0:
        mesh.invert()
    return mesh


def poses_that_heard(
    mesh: trimesh.Trimesh, evidence: Evidence, resolution: float
) -> NDArray[np.int32]:
    """Count the poses that heard the surface around each vertex.

    A pose counts where a point of its evidence lies within two range resolutions of the vertex,
    looks the same way within 60 degrees, and lies on one smooth surface with it.

    Parameters
    ----------
    mesh : Trimesh
        Normals outward, m.
    evidence : Evidence
        Of all poses.
    resolution : float, m
        Range resolution.

    Returns
    -------
    poses : (V,) int32
    """
    counts = np.zeros(len(mesh.vertices), np.int32)
    if not len(evidence.points):
        return counts
    vertices, normals = np.asarray(mesh.vertices), np.asarray(mesh.vertex_normals)
    tree = cKDTree(evidence.points)
    chunk = max(1, _CHUNK * 20 // max(len(evidence.points), 1))
    order = cKDTree(vertices).indices
    for start in range(0, len(order), chunk):
        some = order[start : start + chunk]
        pairs = cKDTree(vertices[some]).sparse_distance_matrix(
            tree, REACH * resolution, output_type="ndarray"
        )
        i, j = pairs["i"], pairs["j"]
        ours, theirs = normals[some[i]], evidence.normals[j]
        alike = np.einsum("nd,nd->n", ours, theirs) > 0.5
        between = evidence.points[j] - vertices[some[i]]
        off = np.abs(np.einsum("nd,nd->n", between, ours + theirs))
        agrees = alike & (off < 2 * ALIGNED * resolution)
        pose = evidence.pose[j[agrees]].astype(np.int64)
        both = np.unique(i[agrees].astype(np.int64) * (evidence.pose.max() + 1) + pose)
        counts[some] = np.bincount(both // (evidence.pose.max() + 1), minlength=len(some))
    return counts
