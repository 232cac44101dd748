# SPDX-License-Identifier: MIT
"""Necks: thin links between thicker parts of a body, which may be there without an echo.

The depth below the surface has a maximum in each part of a body [1]_. A neck is the narrowest place
between two of them, if it is much less deep than both.

References:
    .. [1] F. Meyer, "Topographic distance and watershed lines", Signal Processing 38, 1994.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
import trimesh
from scipy import ndimage
from scipy.spatial import cKDTree
from skimage.morphology import local_maxima, reconstruction
from skimage.segmentation import watershed

from sononerf.array_types import Bools, Floats, Ints
from sononerf.geometry.lattice import level_surface
from sononerf.surface.refine.candidates import LATER
from sononerf.surface.refine.remesh import signed_distance

SPACING = 0.4
"""Spacing of the lattice, shortest wavelengths: what sound resolves is two voxels wide."""
VOXELS = 1_000_000
"""Largest number of voxels of the box around the body, about: they take 0.2 GB. Larger bodies get a
coarser lattice."""
THIN = 0.6
"""Largest depth of a neck; the unit is the depth of the thinner of the parts that it links. Necks
between spheres are less deep; the bumps of one body are linked by more."""
SHALLOW = 2.0
"""Least depth of a part, voxels: the lattice does not resolve thinner ones."""
BLUR = 0.8
"""Standard deviation of the Gaussian that makes a smooth solid of voxels, voxels."""
AROUND = 4
"""Number of voxels around bodies and necks."""
_CUBE = np.ones((3, 3, 3), dtype=bool)


@dataclass(frozen=True, eq=False)
class Neck:
    """A neck of a surface.

    Attributes:
        solid: Closed surface around the neck and nothing else of the body, m.
        places ((N, 3), m): Points that fill the neck.
        reach (m): Distance from the points up to which the surface belongs to the neck.
    """

    solid: trimesh.Trimesh
    places: Floats
    reach: float

    def holds(self, points: Floats) -> Bools:
        """Return which points (N, 3) of a surface, m, lie on the neck."""
        return np.isfinite(cKDTree(self.places).query(points, distance_upper_bound=self.reach)[0])


def without_necks(
    mesh: trimesh.Trimesh, wavelength: float, compare: Callable[[trimesh.Trimesh], float]
) -> tuple[trimesh.Trimesh, Bools]:
    """Cut the necks without which the objective is lower.

    Args:
        wavelength (m): The shortest.

    Returns:
        doubtful (V,): True for vertices where a neck was cut, or where the objective is about the
            same without it.
    """
    necks = find_necks(mesh, wavelength)
    whole = compare(mesh) if necks else math.inf
    if not math.isfinite(whole):
        return mesh, np.zeros(len(mesh.vertices), dtype=bool)
    without = [_compared(_cut(mesh, [neck]), compare) for neck in necks]
    preferred = [neck for neck, one in zip(necks, without, strict=True) if LATER * one <= whole]
    cut = _cut(mesh, preferred) if preferred else mesh
    if preferred and LATER * _compared(cut, compare) <= whole:
        mesh = cut
    doubtful: Bools = np.zeros(len(mesh.vertices), dtype=bool)
    for neck, one in zip(necks, without, strict=True):
        if one <= LATER * whole:
            doubtful |= neck.holds(mesh.vertices)
    return mesh, doubtful


def _cut(mesh: trimesh.Trimesh, necks: list[Neck]) -> trimesh.Trimesh:
    solids = [mesh, *(neck.solid for neck in necks)]
    return trimesh.boolean.difference(solids, engine="manifold", check_volume=False)


def _compared(mesh: trimesh.Trimesh, compare: Callable[[trimesh.Trimesh], float]) -> float:
    return compare(mesh) if len(mesh.faces) else math.inf  # nothing is left of a faulty surface


def find_necks(mesh: trimesh.Trimesh, wavelength: float) -> list[Neck]:
    """Return the necks of a closed surface; none where it is open.

    Args:
        wavelength (m): The shortest.
    """
    if not mesh.is_watertight:
        return []
    spacing = max(SPACING * wavelength, float(np.cbrt(np.prod(mesh.extents) / VOXELS)))
    lower, distance = signed_distance(mesh, spacing, margin=AROUND)
    depth = ndimage.distance_transform_edt(distance < 0)
    log = np.log(np.maximum(depth, 0.5))
    prominent = local_maxima(reconstruction(log + np.log(THIN), log))
    markers, _ = ndimage.label(prominent & (depth >= SHALLOW), _CUBE)
    parts = watershed(-depth, markers, mask=depth > 0)
    found = []
    for border in _borders(parts):
        first, voxels, solid = _neck(border, depth)
        places = lower + spacing * (first + np.argwhere(voxels))
        around = level_surface(solid, 0.0, lower + spacing * first, spacing)
        found.append(Neck(around, places, 2.0 * spacing))
    return found


def _borders(parts: Ints) -> list[Ints]:
    """Return the voxels (N, 3) at both sides of the border of each two parts that meet."""
    sides: list[Ints] = []
    for axis in range(3):
        one, other = parts.swapaxes(0, axis)[:-1], parts.swapaxes(0, axis)[1:]
        at = np.argwhere((one != other) & (one > 0) & (other > 0))
        at[:, [0, axis]] = at[:, [axis, 0]]
        beyond = at + np.eye(3, dtype=np.int64)[axis]
        pair = np.sort([parts[tuple(at.T)], parts[tuple(beyond.T)]], axis=0)
        sides += [np.column_stack([pair.T, places]) for places in (at, beyond)]
    found = np.unique(np.concatenate(sides), axis=0)
    _, first = np.unique(found[:, :2], axis=0, return_index=True)
    return [group[:, 2:] for group in np.split(found, first[1:]) if len(group)]


def _neck(places: Ints, depth: Floats) -> tuple[Ints, Bools, Floats]:
    """Return what an opening takes away around the border of two parts.

    Args:
        places (N, 3): Voxels at the border.
        depth ((X, Y, Z), voxels): Depth below the surface.

    Returns:
        first (3,): First voxel of a box around the neck.
        voxels (A, B, C): The voxels of the neck in the box.
        solid (A, B, C): Below 0 in the neck and a little around it, but not in its body.
    """
    deepest = float(depth[tuple(places.T)].max()) + 1.0
    reach = round(2.0 * deepest) + AROUND
    first = np.maximum(places.min(axis=0) - reach, 0)
    depth = depth[
        tuple(slice(a, b) for a, b in zip(first, places.max(axis=0) + reach + 1, strict=True))
    ]
    border = np.zeros(depth.shape, dtype=bool)
    border[tuple((places - first).T)] = True
    close = ndimage.distance_transform_edt(~border) <= 2.0 * deepest
    opened = ndimage.distance_transform_edt(depth <= deepest) <= deepest
    voxels = border | ((depth > 0) & close & ~opened)
    grown = voxels | (ndimage.binary_dilation(voxels, _CUBE, 2) & (depth == 0))
    return first, voxels, 0.4 - ndimage.gaussian_filter(grown.astype(np.float64), BLUR)
