# SPDX-License-Identifier: MIT
"""Meshes for the boundary-element engine: closed, disjoint bodies of triangles of one size."""

from __future__ import annotations

import math

import numpy as np
import pyvista as pv
import trimesh

from sononerf.array_types import Bools, Floats, Ints
from sononerf.errors import InputError
from sononerf.geometry.raycast import winding_numbers

LONG = 1.5  # edges over the wanted length, above which they are halved
DEVIATION = 0.05  # of the wanted edge: how far a coarser surface may be from the given one
OUTSIDE = 1e-3  # of a triangle's size: how far above its middle no other body may be
FLAT = 0.01  # of the longest edge: quadrilaterals as flat as this are divided anew
TURNS = 20  # passes over all diagonals
FINER = 1.3  # vertices over those that are needed, above which a mesh is made coarser


def expected_vertices(area: float, edge: float) -> int:
    """Return how many vertices a surface (m2) of equilateral triangles with an edge (m) has."""
    return math.ceil(2.0 / math.sqrt(3.0) * area / edge**2)


def closed_bodies(mesh: trimesh.Trimesh) -> trimesh.Trimesh:
    """Return a surface with each vertex once, if its bodies are closed."""
    bodies = trimesh.Trimesh(
        np.asarray(mesh.vertices, np.float64), np.asarray(mesh.faces), process=False
    )
    bodies.merge_vertices(merge_tex=True, merge_norm=True)
    bodies.update_faces(bodies.nondegenerate_faces())
    bodies.remove_unreferenced_vertices()
    _, uses = np.unique(np.sort(bodies.edges, axis=1), axis=0, return_counts=True)
    odd = int((uses % 2).sum())
    if odd:
        raise InputError(
            f"simulation.engine=bem needs closed bodies; {odd} edges of the mesh belong to one "
            "triangle alone: close it, or set simulation.engine=kirchhoff"
        )
    return bodies


def check_apart(bodies: trimesh.Trimesh) -> None:
    """Refuse bodies that overlap, touch, or are inside out."""
    size = np.sqrt(bodies.area_faces)
    above = bodies.triangles_center + OUTSIDE * size[:, None] * bodies.face_normals
    wrong = int((np.abs(winding_numbers(bodies.vertices, bodies.faces, above)) > 0.25).sum())
    if wrong:
        raise InputError(
            f"simulation.engine=bem needs bodies that lie apart; {wrong} of {len(size)} triangles "
            "lie in another body or face inwards: unite the bodies, or set "
            "simulation.engine=kirchhoff"
        )


def suited(bodies: trimesh.Trimesh, edge: float) -> trimesh.Trimesh:
    """Return the same bodies with triangles of about one size.

    A mesh that is much finer is made coarser by quadric decimation, which keeps the volume [1]_.
    The coarsest mesh is taken that deviates by no more than a twentieth of ``edge``. Long edges
    are halved; curved surfaces stay as flat as they are.

    Args:
        edge (m): The wanted length of edges.

    References:
        .. [1] M. Garland and P. S. Heckbert, "Surface simplification using quadric error metrics",
           SIGGRAPH 1997.
    """
    least = expected_vertices(bodies.area, edge)
    best = halved(bodies, LONG * edge)
    wanted = least // 2  # long edges are halved later
    # Facets that are narrow and long need both: they are divided first, then made coarser.
    fine = max(bodies, best, key=lambda mesh: len(mesh.vertices))
    while FINER * wanted < len(fine.vertices):
        coarse = _coarser(fine, wanted, DEVIATION * edge)
        if coarse is not None:
            coarse = halved(coarse, LONG * edge)
            if len(coarse.vertices) < len(best.vertices):
                best = coarse
            break
        wanted = math.ceil(1.5 * wanted)
    return best


def _coarser(bodies: trimesh.Trimesh, wanted: int, deviation: float) -> trimesh.Trimesh | None:
    """Return a mesh of about so many vertices, or None where none is near enough and closed."""
    surface = pv.make_tri_mesh(np.asarray(bodies.vertices), np.asarray(bodies.faces))
    less = surface.decimate(1.0 - 2.0 * wanted / len(bodies.faces), volume_preservation=True)
    if less.n_cells == 0:
        return None
    coarse = trimesh.Trimesh(less.points, less.faces.reshape(-1, 4)[:, 1:], process=False)
    far = max(_deviation(surface, less), _deviation(less, surface))
    if far > deviation:
        return None
    try:
        coarse = closed_bodies(coarse)
    except InputError:
        return None
    # A thin body must not have lost a side, nor its volume.
    return coarse if abs(coarse.volume / bodies.volume - 1.0) < 0.02 else None


def _deviation(points: pv.PolyData, surface: pv.PolyData) -> float:
    distance = points.compute_implicit_distance(surface)["implicit_distance"]
    return float(np.abs(np.asarray(distance)).max())


def halved(mesh: trimesh.Trimesh, longest: float) -> trimesh.Trimesh:
    """Halve edges, and the triangles on both sides with them, until all are short.

    In each pass an edge is halved if it is the longest of all its triangles [1]_, creases before
    other edges. Then diagonals of flat quadrilaterals are turned where that makes them shorter
    in Delaunay's sense. So long thin triangles become shorter and not thinner.

    Args:
        longest (m): No edge stays longer.

    References:
        .. [1] M.-C. Rivara, "Algorithms for refining triangular grids suitable for adaptive and
           multigrid techniques", International Journal for Numerical Methods in Engineering 20,
           1984.
    """
    vertices, faces = np.asarray(mesh.vertices, np.float64), np.asarray(mesh.faces, np.int64)
    while True:
        edges = _Edges(vertices, faces)
        if edges.length.max() <= longest:
            return trimesh.Trimesh(vertices, faces, process=False)
        crease = (edges.lift(vertices) > FLAT * longest) & (edges.length > longest)
        first = edges.first(edges.length + np.where(crease, edges.length.max(), 0.0))
        chosen = edges.won(first) & (edges.length > longest)
        middle = np.full(len(chosen), -1)
        middle[chosen] = len(vertices) + np.arange(int(chosen.sum()))
        vertices = np.concatenate([vertices, vertices[edges.ends[chosen]].mean(axis=1)])
        new = middle[edges.sides[np.arange(len(faces)), first]]
        cut = new >= 0
        order = (first[cut, None] + np.arange(3)) % 3
        a, b, c = np.take_along_axis(faces[cut], order, axis=1).T
        x = new[cut]
        halves = np.concatenate([np.stack([a, b, x], axis=1), np.stack([a, x, c], axis=1)])
        faces = _turned(vertices, np.concatenate([faces[~cut], halves]), FLAT * longest)


class _Edges:
    """The edges of triangles, each once.

    Attributes:
        ends (Q, 2): Vertices.
        sides (T, 3): Edge opposite to each corner.
        length ((Q,), m): Length of each.
        pair (Q, 2): Its two triangles; -1 where there are not just two.
    """

    def __init__(self, vertices: Floats, faces: Ints) -> None:
        pairs = np.sort(faces[:, [[1, 2], [2, 0], [0, 1]]], axis=2).reshape(-1, 2)
        self.ends, sides, uses = np.unique(pairs, axis=0, return_inverse=True, return_counts=True)
        self.sides = sides.reshape(-1, 3)
        self.length = np.linalg.norm(np.diff(vertices[self.ends], axis=1)[:, 0], axis=1)
        order = np.argsort(sides.ravel(), kind="stable")
        start = np.cumsum(uses) - uses
        self.pair = np.full((len(uses), 2), -1)
        self.opposite = np.full((len(uses), 2), -1)
        two = uses == 2
        for side in range(2):
            corner = order[start[two] + side]
            self.pair[two, side] = corner // 3
            self.opposite[two, side] = faces.ravel()[corner]

    def lift(self, vertices: Floats) -> Floats:
        """Return how far apart both diagonals about an edge are (Q,), m; endless if there are none.

        So much the surface changes where a diagonal is turned.
        """
        a, b = (vertices[self.ends[:, end]] for end in range(2))
        c, d = (vertices[self.opposite[:, side]] for side in range(2))
        square = np.cross(b - a, d - c)
        length = np.linalg.norm(square, axis=1)
        apart = np.abs(np.einsum("qd,qd->q", square, c - a))
        apart /= np.where(length > 0.0, length, 1.0)
        return np.where((length > 0.0) & (self.pair[:, 0] >= 0), apart, np.inf)

    def first(self, key: Floats) -> Ints:
        """Return the corner (T,) opposite to the side with the greatest key (Q,)."""
        # Of equal ones the number decides.
        self._rank = np.zeros(len(key), dtype=np.int64)
        self._rank[np.argsort(key, kind="stable")] = np.arange(len(key))
        found: Ints = self._rank[self.sides].argmax(axis=1)
        return found

    def won(self, first: Ints) -> Bools:
        """Return the edges (Q,) that are first in all their triangles."""
        beaten = np.ones(self.sides.shape, dtype=bool)
        beaten[np.arange(len(first)), first] = False
        won = np.ones(len(self.ends), dtype=bool)
        won[self.sides[beaten]] = False
        return won


def _turned(vertices: Floats, faces: Ints, flat: float) -> Ints:
    """Turn diagonals of quadrilaterals that are flat within a length (m), by Delaunay's rule."""
    for _ in range(TURNS):
        edges = _Edges(vertices, faces)
        a, b = (vertices[edges.ends[:, end]] for end in range(2))
        c, d = (vertices[edges.opposite[:, side]] for side in range(2))
        angles = _angle(a - c, b - c) + _angle(a - d, b - d)
        # Both angles at the ends below 180 degrees: the other diagonal lies within.
        inside = np.ones(len(a), dtype=bool)
        for end, other in ((a, b), (b, a)):
            sum_ = _angle(c - end, other - end) + _angle(d - end, other - end)
            inside &= sum_ < np.pi - 1e-3
        wanted = (edges.lift(vertices) < flat) & inside & (angles > np.pi + 1e-6)
        count = len(vertices)
        there = edges.ends[:, 0] * count + edges.ends[:, 1]
        new = np.sort(edges.opposite, axis=1)
        wanted &= ~np.isin(new[:, 0] * count + new[:, 1], there)
        won = wanted & edges.won(edges.first(np.where(wanted, angles, -1.0)))
        chosen = np.flatnonzero(won)
        _, alone = np.unique(new[chosen], axis=0, return_index=True)
        chosen = chosen[alone]
        if not len(chosen):
            break
        one, other = edges.pair[chosen].T
        apex, foot = edges.opposite[chosen].T
        at = (faces[one] == apex[:, None]).argmax(axis=1)
        left = faces[one, (at + 1) % 3]
        right = faces[one, (at + 2) % 3]
        faces = faces.copy()
        faces[one] = np.stack([apex, left, foot], axis=1)
        faces[other] = np.stack([apex, foot, right], axis=1)
    return faces


def _angle(a: Floats, b: Floats) -> Floats:
    cross = np.linalg.norm(np.cross(a, b), axis=1)
    found: Floats = np.arctan2(cross, np.einsum("qd,qd->q", a, b))
    return found
