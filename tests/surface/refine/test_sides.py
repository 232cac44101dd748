# SPDX-License-Identifier: MIT
from __future__ import annotations

import numpy as np
import pytest
import torch
import trimesh

from sononerf.surface.refine.descent import Sides

THICK = 1e-3


@pytest.fixture
def plate():
    mesh = trimesh.creation.box((0.02, 0.02, THICK))
    for _ in range(4):
        mesh = mesh.subdivide()
    return mesh


def moved(plate, least, shift):
    """A plate whose upper side was moved by so much, after its sides were kept apart."""
    sides = Sides(plate, least)
    vertices = torch.as_tensor(np.array(plate.vertices))
    upper = (vertices[:, 2] > 0).double()[:, None]
    vertices = vertices + upper * torch.tensor([0.0, 0.0, shift])
    normals = torch.as_tensor(np.array(plate.vertex_normals))
    return vertices, sides.apart(vertices, normals)


def inner(vertices):
    return vertices[vertices[:, :2].abs().amax(1) < 0.008]


def test_sides_that_crossed_are_parted_by_the_least_thickness(plate):
    least = 5e-4
    _, found = moved(plate, least, -1.5 * THICK)
    heights = inner(found)[:, 2]
    middle = -0.75 * THICK
    np.testing.assert_allclose((heights - middle).abs().numpy(), least / 2, rtol=1e-6)
    upper = inner(torch.as_tensor(np.array(plate.vertices)))[:, 2] > 0
    assert torch.equal(heights > middle, upper)


def test_sides_that_are_apart_stay_where_they_are(plate):
    before, found = moved(plate, 5e-4, 0.0)
    torch.testing.assert_close(inner(found), inner(before), rtol=0, atol=0)


def test_a_thick_body_has_no_opposite_vertices():
    ball = trimesh.creation.icosphere(subdivisions=3, radius=0.01)
    vertices = torch.as_tensor(np.array(ball.vertices))
    normals = torch.as_tensor(np.array(ball.vertex_normals))
    assert torch.equal(Sides(ball, 1.0).apart(vertices, normals), vertices)
