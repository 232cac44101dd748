# SPDX-License-Identifier: MIT
"""A mesh as the solid union of its bodies: its outer surface, its volume, its parts."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np
import trimesh
from numpy.typing import NDArray

from sononerf.errors import NumericalError
from sononerf.evaluation.nearest import SLACK, Nearest, polydata
from sononerf.evaluation.parts import split_parts, submesh

# Rejection keeps what lies outside; after so many rounds there is no outer surface to be found.
MAX_ROUNDS = 100


def signed_distance(points: NDArray[np.float64], mesh: trimesh.Trimesh) -> NDArray[np.float64]:
    """Return the exact distance of points (N, 3) to a mesh, (N,) m, negative inside."""
    return Nearest(mesh).signed(points)


@dataclass(frozen=True, eq=False)
class Solid:
    """The bodies of a mesh, taken together.

    Parameters
    ----------
    bodies : list of Trimesh
        Parts that are closed, facing outward.
    sheets : list of Trimesh
        Parts that are open.
    """

    bodies: list[trimesh.Trimesh]
    sheets: list[trimesh.Trimesh]

    @cached_property
    def parts(self) -> list[trimesh.Trimesh]:
        """All parts, closed ones first."""
        return [*self.bodies, *self.sheets]

    @cached_property
    def nearest(self) -> list[Nearest]:
        """Distances to each part, in the same order."""
        return [Nearest(part) for part in self.parts]

    @property
    def closed(self) -> bool:
        """Whether every part is closed, so that there is an inside."""
        return bool(self.bodies) and not self.sheets

    def contains(
        self, points: NDArray[np.float64], *, other_than: int | None = None
    ) -> NDArray[np.bool_]:
        """Return whether points (N, 3) lie inside any body, one of them perhaps left out."""
        inside = np.zeros(len(points), bool)
        for index, body in enumerate(self.bodies):
            if index == other_than:
                continue
            low, high = body.bounds
            near = np.flatnonzero(((points > low) & (points < high)).all(axis=1) & ~inside)
            inside[near] = self.nearest[index].signed(points[near]) < 0
        return inside


def _merged(mesh: trimesh.Trimesh) -> trimesh.Trimesh:
    if not len(mesh.faces):
        raise NumericalError("the mesh is empty: it has no triangle")
    if not np.isfinite(mesh.vertices).all():
        raise NumericalError("the mesh has vertices that are not finite")
    if mesh.is_watertight:
        return mesh
    # STL and many others store each triangle's corners apart; closed is closed only once merged.
    merged = trimesh.Trimesh(mesh.vertices, mesh.faces, process=True, validate=False)
    a, b, c = np.asarray(merged.faces).T
    merged.update_faces((a != b) & (b != c) & (c != a))
    if not len(merged.faces):
        raise NumericalError("the mesh has no triangle with an area")
    return merged


def solid_from_mesh(mesh: trimesh.Trimesh, *, drop_cavities: bool) -> Solid:
    """Take a mesh apart into its bodies.

    Parameters
    ----------
    mesh : Trimesh
        Closed bodies, which may overlap, and open sheets.
    drop_cavities : bool
        Whether the walls of closed hollows, which no sound reaches, are left out. A body that faces
        inward and is no hollow is turned inside out either way.

    Raises
    ------
    NumericalError
        If the mesh is empty or not finite.
    """
    bodies, cavities, sheets = [], [], []
    for part in split_parts(_merged(mesh)):
        if not part.is_watertight:
            sheets.append(part)
        elif part.volume < 0:
            cavities.append(part)
        else:
            bodies.append(part)
    outer = Solid(list(bodies), [])
    for part in cavities:
        if outer.contains(np.asarray(part.vertices[:1])).all() and bodies:
            if not drop_cavities:
                bodies.append(part)
        else:
            part.invert()
            bodies.append(part)
    return Solid(bodies, sheets)


def outer_surface(mesh: trimesh.Trimesh) -> trimesh.Trimesh:
    """Return the outer surface of the solid union of a mesh's closed bodies.

    Triangles whose centroid lies inside another body are left out, so that where two bodies meet
    the seam is true to one triangle: refine coarse bodies that overlap. Sheets stay, except inside
    a body; the walls of hollows go.

    Parameters
    ----------
    mesh : Trimesh
        Closed bodies, which may overlap, and open sheets.

    Returns
    -------
    mesh : Trimesh
        A new mesh, open along the seams.

    Raises
    ------
    NumericalError
        If the mesh is empty or not finite.
    """
    return outer_surface_of(solid_from_mesh(mesh, drop_cavities=True))


def outer_surface_of(solid: Solid) -> trimesh.Trimesh:
    """Return the outer surface of a solid; see :func:`outer_surface`."""
    kept = []
    for index, part in enumerate(solid.parts):
        hidden = solid.contains(np.asarray(part.triangles_center), other_than=index)
        if not hidden.all():
            kept.append(submesh(part, ~hidden) if hidden.any() else part)
    if not kept:
        # Two bodies in the very same place hide one another.
        kept = [solid.parts[0]]
    return trimesh.util.concatenate(kept)


def sample_surface(
    mesh: trimesh.Trimesh, count: int, generator: np.random.Generator
) -> tuple[NDArray[np.float64], NDArray[np.intp]]:
    """Draw points uniformly by area; returns points (count, 3) m and their triangles (count,)."""
    cumulative = np.cumsum(np.asarray(mesh.area_faces, dtype=np.float64))
    if not len(cumulative) or not cumulative[-1] > 0:
        raise NumericalError("the mesh has no area to draw points from")
    face = np.searchsorted(cumulative, generator.random(count) * cumulative[-1], side="right")
    face = np.minimum(face, len(cumulative) - 1)
    u, v = generator.random((2, count))
    flip = u + v > 1
    u, v = np.where(flip, 1 - u, u), np.where(flip, 1 - v, v)
    a, b, c = np.asarray(mesh.triangles)[face].transpose(1, 0, 2)
    return a + u[:, None] * (b - a) + v[:, None] * (c - a), face


def sample_outer_surface(
    mesh: trimesh.Trimesh, count: int, seed: int = 0
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Draw points uniformly by area from the outer surface of a solid union.

    Points inside another body are thrown away one by one, so that the seams are exact.

    Parameters
    ----------
    mesh : Trimesh
        Closed bodies, which may overlap, and open sheets.
    count : int
        Number of points.
    seed : int
        The same seed draws the same points.

    Returns
    -------
    points : (count, 3) float, m
        On the outer surface.
    normals : (count, 3) float
        Unit normals of the triangles they lie on.

    Raises
    ------
    NumericalError
        If the mesh is empty, not finite, or has no outer surface.
    """
    return sample_solid(solid_from_mesh(mesh, drop_cavities=True), count, seed)


def sample_solid(
    solid: Solid, count: int, seed: int
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Draw points from the outer surface of a solid; see :func:`sample_outer_surface`."""
    generator = np.random.default_rng(seed)
    whole = trimesh.util.concatenate(solid.parts)
    owner = np.repeat(np.arange(len(solid.parts)), [len(part.faces) for part in solid.parts])
    boxes = np.array([body.bounds for body in solid.bodies]).reshape(-1, 2, 3)
    normals = np.asarray(whole.face_normals)
    found: list[tuple[NDArray[np.float64], NDArray[np.intp]]] = []
    missing = count
    for _ in range(MAX_ROUNDS):
        points, face = sample_surface(whole, max(1000, missing), generator)
        keep = np.ones(len(points), bool)
        for index, (low, high) in enumerate(boxes):
            near = np.flatnonzero(
                ((points > low) & (points < high)).all(axis=1) & (owner[face] != index) & keep
            )
            keep[near] = solid.nearest[index].signed(points[near]) >= 0
        found.append((points[keep], face[keep]))
        missing -= int(keep.sum())
        if missing <= 0:
            points = np.concatenate([p for p, _ in found])[:count]
            face = np.concatenate([f for _, f in found])[:count]
            return points, normals[face]
    raise NumericalError("the mesh has no outer surface: every body lies inside another")


def count_parts(solid: Solid, *, min_area_fraction: float = 0.01) -> int:
    """Count the connected parts of the union; bodies that overlap or touch are one part.

    Parts with less than ``min_area_fraction`` of the largest part's area are not counted.
    """
    parts = solid.parts
    group = np.arange(len(parts))
    for i, j in _pairs_whose_boxes_meet(parts):
        # Two that hang together by way of others need not be looked at.
        if group[i] != group[j] and _overlap(solid, i, j):
            group[group == group[j]] = group[i]
    areas = np.bincount(group, weights=[part.area for part in parts])
    return int((areas > min_area_fraction * areas.max()).sum())


def _pairs_whose_boxes_meet(parts: list[trimesh.Trimesh]) -> list[tuple[int, int]]:
    """Return the pairs of parts whose bounding boxes share a place."""
    boxes = np.array([part.bounds for part in parts])
    found = []
    for i in range(len(parts) - 1):
        rest = boxes[i + 1 :]
        meet = ((boxes[i, 0] <= rest[:, 1]) & (rest[:, 0] <= boxes[i, 1])).all(axis=1)
        found += [(i, i + 1 + int(j)) for j in np.flatnonzero(meet)]
    return found


def _overlap(solid: Solid, i: int, j: int) -> bool:
    """Return whether two parts' surfaces cross, or one lies inside the other."""
    # The later one is the smaller: of two nested ones it lies inside.
    for inner, outer in ((j, i), (i, j)):
        if outer < len(solid.bodies):
            low, high = solid.parts[outer].bounds
            corners = np.asarray(solid.parts[inner].vertices)
            near = corners[((corners >= low) & (corners <= high)).all(axis=1)]
            # A single corner settles it more often than not.
            if (solid.nearest[outer].signed(near[:1]) < 0).any():
                return True
            if (solid.nearest[outer].signed(near[1:]) < 0).any():
                return True
    # Triangles may cross though no corner lies inside; only those near both can.
    one, two = _triangles_near(solid, i, j), _triangles_near(solid, j, i)
    if not (len(one.faces) and len(two.faces)):
        return False
    return bool(polydata(one).collision(polydata(two), contact_mode=1)[1])


def _triangles_near(solid: Solid, index: int, other: int) -> trimesh.Trimesh:
    """Return those of a part's triangles that can cross one of another part's.

    What two triangles share is nearer to a corner of each than that one's longest side.
    """
    part, target = solid.parts[index], solid.parts[other]
    low = np.maximum(part.bounds[0], target.bounds[0])
    high = np.minimum(part.bounds[1], target.bounds[1])
    triangles = np.asarray(part.triangles)
    chosen = ((triangles.min(axis=1) <= high) & (triangles.max(axis=1) >= low)).all(axis=1)
    faces = np.asarray(part.faces)
    used = np.unique(faces[chosen])
    reach = float(part.edges_unique_length.max() + target.edges_unique_length.max())
    distance = np.full(len(part.vertices), np.inf)
    distance[used] = solid.nearest[other].corners.query(
        np.asarray(part.vertices)[used], distance_upper_bound=reach * (1 + SLACK)
    )[0]
    chosen &= (distance[faces] < np.inf).any(axis=1)
    return submesh(part, chosen)
