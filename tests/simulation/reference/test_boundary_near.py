# SPDX-License-Identifier: MIT
import numpy as np
import pytest
import trimesh

from sononerf.simulation.reference.boundary_near import (
    POINTS,
    WEIGHTS,
    Panels,
    near_pairs,
    potentials,
)

pytestmark = pytest.mark.thorough

TRIANGLE = np.array([[0.0, 0.0, 0.0], [1.2, 0.1, 0.0], [0.3, 0.9, 0.0]])
PLACES = {
    "above": (0.5, 0.3, 0.4),
    "below": (0.5, 0.3, -0.2),
    "close": (0.45, 0.35, 1e-3),
    "inside": (0.45, 0.35, 0.0),
    "beside": (1.5, 0.8, 0.0),
    "beside and close to the plane": (-0.3, 0.2, 1e-3),
    "on an edge's line": (2.4, 0.2, 0.0),
    "behind an edge's line": (-1.2, -0.1, 0.0),
    "above a corner": (1.2, 0.1, 0.3),
}


def kernels(distance, height):
    return np.stack([1 / distance, distance, height / distance**3, height / distance])


def by_quadrature(point):
    """Sum signed triangles from the point's foot to the edges, in polar coordinates.

    The radius is |z| sinh(t), on which all kernels are smooth.
    """
    height, total = point[2], np.zeros((4, 3))
    nodes, weights = np.polynomial.legendre.leggauss(120)
    nodes, weights = (nodes + 1) / 2, weights / 2
    scale = max(abs(height), 1e-12)
    for start, end in zip(TRIANGLE, np.roll(TRIANGLE, -1, axis=0), strict=True):
        away, edge = (start - point)[:2], (end - start)[:2]
        side = away[0] * edge[1] - away[1] * edge[0]  # twice the signed area
        if abs(side) < 1e-12:
            continue
        along = edge / np.linalg.norm(edge)
        off = side / np.linalg.norm(edge)
        # l = |off| sinh(u) along the edge takes even the angle's peak.
        ends = np.arcsinh(np.array([away @ along, (away + edge) @ along]) / abs(off))
        u = ends[0] + np.diff(ends) * nodes
        rim = abs(off) * np.cosh(u)
        angle_weight = np.diff(ends) * weights / np.cosh(u) * np.sign(off)
        top = np.arcsinh(rim / scale)
        radius = scale * np.sinh(top[:, None] * nodes)
        slope = scale * np.cosh(top[:, None] * nodes) * top[:, None] * weights
        normal = np.array([along[1], -along[0]])
        unit = (abs(off) * np.sinh(u))[:, None] * along + off * normal
        unit /= np.linalg.norm(unit, axis=1)[:, None]
        places = point[:2] + radius[..., None] * unit[:, None]
        corner = np.linalg.solve(
            np.vstack([TRIANGLE[:, :2].T, np.ones(3)]),
            np.concatenate([places.reshape(-1, 2).T, np.ones((1, radius.size))]),
        ).reshape(3, *radius.shape)
        value = kernels(np.hypot(radius, scale if height else 0.0), height)
        weight = angle_weight[:, None] * slope * radius
        total += np.einsum("kij,cij,ij->kc", value, corner, weight)
    return total


@pytest.mark.parametrize("place", PLACES)
def test_potentials_are_the_integrals_over_the_triangle(place):
    point = np.array(PLACES[place])
    panels = Panels.of(TRIANGLE, [[0, 1, 2]])
    found = potentials(TRIANGLE[None], panels.normals, panels.slopes, point[None, None])
    np.testing.assert_allclose(found[:, 0, 0], by_quadrature(point), rtol=1e-7, atol=1e-9)


def test_the_seven_points_are_exact_to_degree_five():
    x, y = POINTS[:, 0], POINTS[:, 1]
    # Over the triangle, relative to its area: 2 a! b! / (a + b + 2)!.
    for a, b, exact in ((0, 0, 1.0), (5, 0, 2 * 120 / 5040), (3, 2, 2 * 12 / 5040)):
        assert WEIGHTS @ (x**a * y**b) == pytest.approx(exact)


def test_near_pairs_are_mutual_and_hold_those_that_touch():
    mesh = trimesh.creation.box((1.0, 0.5, 0.01)).subdivide()
    panels = Panels.of(mesh.vertices, mesh.faces)
    pairs = set(zip(*(side.tolist() for side in near_pairs(panels)), strict=True))
    assert pairs == {(b, a) for a, b in pairs}
    assert all((a, a) in pairs for a in range(len(mesh.faces)))
    assert {tuple(pair) for pair in mesh.face_adjacency.tolist()} <= pairs
