# SPDX-License-Identifier: MIT
from __future__ import annotations

import math

import numpy as np
import pytest
import torch
import trimesh

from sononerf.surface.refine.mesh_operators import MeshOperators, tangents, unit


def operators(mesh):
    faces = torch.as_tensor(np.array(mesh.faces, dtype=np.int64))
    vertices = torch.as_tensor(np.array(mesh.vertices, dtype=np.float64))
    return MeshOperators(faces, len(vertices)), vertices


def test_vector_areas_point_outwards_and_add_up(ball):
    on, vertices = operators(ball)
    area = on.areas(vertices)
    assert float(area.sum(0).norm()) < 1e-12
    assert float((area * unit(vertices)).sum()) == pytest.approx(ball.area, rel=0.01)


def test_a_sphere_bends_alike_in_all_directions(ball):
    on, vertices = operators(ball)
    normals = unit(on.areas(vertices))
    bending = on.bending(vertices, normals, 1)
    first, _ = tangents(normals)
    xx, yy, zz, xy, xz, yz = bending.unbind(1)
    x, y, z = first.unbind(1)
    along = x * x * xx + y * y * yy + z * z * zz + 2 * (x * y * xy + x * z * xz + y * z * yz)
    radius = float(vertices[0].norm())
    assert np.allclose(along, 1 / radius, rtol=0.06)


def test_a_cylinder_bends_across_its_axis_alone():
    mesh = trimesh.creation.cylinder(radius=0.01, height=0.1, sections=64).subdivide_loop(1)
    on, vertices = operators(mesh)
    bending = on.bending(vertices, unit(on.areas(vertices)), 1)
    middle = (vertices[:, 2].abs() < 0.02) & (vertices[:, :2].norm(dim=1) > 0.009)
    assert float(bending[middle, 2].abs().max()) < 6.0
    assert np.allclose((bending[:, 0] + bending[:, 1])[middle], 100.0, rtol=0.1)


def test_smoothing_solves_its_equation(ball):
    on, vertices = operators(ball)
    values = torch.as_tensor(np.random.default_rng(0).standard_normal((len(vertices), 2)))
    strength = 20.0
    found = on.smoothed(values, strength)
    back = found + strength * (on.degree[:, None] * found - on.neighbours(found))
    assert float((back - values).norm() / values.norm()) < 0.03
    assert float(found.sum()) == pytest.approx(float(values.sum()), abs=0.5)


def test_tangents_are_square_to_the_normals_and_to_each_other():
    normals = unit(torch.as_tensor(np.random.default_rng(1).standard_normal((50, 3))))
    first, second = tangents(normals)
    for a, b in ((first, second), (first, normals), (second, normals)):
        assert float((a * b).sum(1).abs().max()) < 1e-12
    assert np.allclose(first.norm(dim=1), 1.0)


def test_relaxation_evens_edges_and_keeps_the_shape(ball):
    on, vertices = operators(ball)
    noise = torch.as_tensor(np.random.default_rng(2).standard_normal(vertices.shape))
    normals = unit(vertices)
    shaken = vertices + 2e-4 * (noise - (noise * normals).sum(1, keepdim=True) * normals)

    def unevenness(places):
        ends = places[on.edges]
        length = (ends[:, 0] - ends[:, 1]).norm(dim=1)
        return float(length.std() / length.mean())

    moved = shaken
    for _ in range(5):
        moved = on.relaxed(moved, unit(on.areas(moved)), 0.5)
    assert unevenness(moved) < 0.6 * unevenness(shaken)
    radius = float(vertices[0].norm())
    assert math.isclose(float(moved.norm(dim=1).mean()), radius, rel_tol=5e-3)
