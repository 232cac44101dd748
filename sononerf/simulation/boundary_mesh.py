# SPDX-License-Identifier: MIT
"""Meshes for the boundary-element engine: closed, disjoint bodies of triangles of one size."""

from __future__ import annotations

import math

import numpy as np
import pyvista as pv
import trimesh
from numpy.typing import NDArray

from sononerf.errors import InputError
from sononerf.geometry.inside import winding_numbers

LONG = 1.5  # edges over the wanted length, above which they are halved
DEVIATION = 0.05  # of the wanted edge: how far a coarser surface may be from the given one
PASSES = 30  # of halving; an edge of a kilometre is then a micrometre long
OUTSIDE = 1e-3  # of a triangle's size: how far above its middle no other body may be
FINER = 1.3  # vertices over those that are needed, above which a mesh is made coarser


def expected_vertices(area: float, edge: float) -> int:
    """Return how many vertices a surface (m2) of equilateral triangles with an edge (m) has."""
    return math.ceil(2.0 / math.sqrt(3.0) * area / edge**2)


def closed_bodies(mesh: trimesh.Trimesh) -> trimesh.Trimesh:
    """Return a surface with each vertex once, if its bodies are closed and disjoint.

    Parameters
    ----------
    mesh : trimesh.Trimesh
        Anticlockwise triangles as seen from outside.

    Returns
    -------
    bodies : trimesh.Trimesh
        Without triangles that have no area.

    Raises
    ------
    InputError
        If a body is open or inside out, or lies in another one.
    """
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
    size = np.sqrt(bodies.area_faces)
    above = bodies.triangles_center + OUTSIDE * size[:, None] * bodies.face_normals
    wrong = int((np.abs(winding_numbers(bodies.vertices, bodies.faces, above)) > 0.25).sum())
    if wrong:
        raise InputError(
            f"simulation.engine=bem needs bodies that lie apart; {wrong} of {len(size)} triangles "
            "lie in another body or face inwards: unite the bodies, or set "
            "simulation.engine=kirchhoff"
        )
    return bodies


def suited(bodies: trimesh.Trimesh, edge: float) -> trimesh.Trimesh:
    """Return the same bodies with triangles of about one size.

    A mesh that is much finer is made coarser by quadric decimation, which keeps the volume [1]_.
    The coarsest mesh is taken that deviates by no more than a twentieth of ``edge``. Long edges
    are halved; curved surfaces stay as flat as they are.

    Parameters
    ----------
    bodies : trimesh.Trimesh
        As :func:`closed_bodies` returns them.
    edge : float, m
        The wanted length of edges.

    Returns
    -------
    mesh : trimesh.Trimesh
        Closed as well.

    References
    ----------
    .. [1] M. Garland and P. S. Heckbert, "Surface simplification using quadric error metrics",
       SIGGRAPH 1997.
    """
    least = expected_vertices(bodies.area, edge)
    best = halved(bodies, LONG * edge)
    wanted = least // 2  # long edges are halved later
    while FINER * wanted < len(bodies.vertices):
        coarse = _coarser(bodies, wanted, DEVIATION * edge)
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

    Parameters
    ----------
    mesh : trimesh.Trimesh
        Closed or not.
    longest : float, m
        No edge stays longer.

    Returns
    -------
    mesh : trimesh.Trimesh
        The same surface. Closed if it was closed.
    """
    vertices, faces = np.asarray(mesh.vertices, np.float64), np.asarray(mesh.faces, np.int64)
    for _ in range(PASSES):
        pairs = np.sort(faces[:, [[1, 2], [2, 0], [0, 1]]], axis=2).reshape(-1, 2)
        ends, sides = np.unique(pairs, axis=0, return_inverse=True)
        length = np.linalg.norm(vertices[ends[:, 0]] - vertices[ends[:, 1]], axis=1)
        long = np.flatnonzero(length > longest)
        if not len(long):
            break
        middle = np.full(len(ends), -1)
        middle[long] = len(vertices) + np.arange(len(long))
        vertices = np.concatenate([vertices, vertices[ends[long]].mean(axis=1)])
        faces = _divided(vertices, faces, middle[sides.reshape(-1, 3)])
    return trimesh.Trimesh(vertices, faces, process=False)


def _divided(
    vertices: NDArray[np.float64], faces: NDArray[np.int64], middle: NDArray[np.int64]
) -> NDArray[np.int64]:
    """Cut triangles (T, 3) at the middles of the edges opposite to corners; -1 where whole."""
    cut = middle >= 0
    count = cut.sum(axis=1)
    # The first corner becomes the one opposite to the only edge that is cut, or that is whole.
    odd = np.where(count == 1, cut.argmax(axis=1), (~cut).argmax(axis=1))
    order = (odd[:, None] + np.arange(3)) % 3
    a, b, c = np.take_along_axis(faces, order, axis=1).T
    x, y, z = np.take_along_axis(middle, order, axis=1).T  # of b c, of c a, of a b
    kinds = [np.flatnonzero(count == number) for number in range(4)]
    made = [faces[kinds[0]]]
    i = kinds[1]
    made += [_triangles(a, b, x, i), _triangles(a, x, c, i)]
    i = kinds[2]
    made.append(_triangles(a, z, y, i))
    # Of the four corners that are left the shorter diagonal is drawn.
    short = np.linalg.norm(vertices[z[i]] - vertices[c[i]], axis=1) <= np.linalg.norm(
        vertices[b[i]] - vertices[y[i]], axis=1
    )
    one, other = i[short], i[~short]
    made += [_triangles(z, b, c, one), _triangles(z, c, y, one)]
    made += [_triangles(z, b, y, other), _triangles(b, c, y, other)]
    i = kinds[3]
    made += [_triangles(*of, i) for of in ((a, z, y), (z, b, x), (y, x, c), (x, y, z))]
    return np.concatenate(made)


def _triangles(
    a: NDArray[np.int64], b: NDArray[np.int64], c: NDArray[np.int64], some: NDArray[np.int64]
) -> NDArray[np.int64]:
    return np.stack([a[some], b[some], c[some]], axis=1)
