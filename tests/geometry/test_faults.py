# SPDX-License-Identifier: MIT
import time

import numpy as np
import pytest
import trimesh

from sononerf.geometry.meshes import surface_faults

BOX = trimesh.creation.box((1.0, 1.0, 1.0))


def ball(radius, centre=(0.0, 0.0, 0.0)):
    mesh = trimesh.creation.icosphere(subdivisions=3, radius=radius)
    mesh.apply_translation(centre)
    return mesh


def faults(vertices, faces):
    return surface_faults(trimesh.Trimesh(vertices, faces, process=False))


@pytest.mark.parametrize(
    "meshes",
    [
        (BOX,),
        (ball(1.0), ball(1.0, (1.2, 0.1, 0.0))),
        (trimesh.creation.torus(2.0, 0.5), ball(0.4)),  # in its hole
        tuple(ball(1.0, (2.5 * k, 0, 0)) for k in range(5)),
    ],
)
def test_good_surfaces_are_passed_over(meshes):
    assert surface_faults(trimesh.util.concatenate(meshes)) == []


def test_open():
    assert faults(BOX.vertices, BOX.faces[:-1]) == [
        "the mesh is open (3 edges of one triangle alone); volumes will not be measured"
    ]


def test_edges_of_more_than_two_triangles():
    other = BOX.copy()
    other.apply_translation([1.0, 1.0, 0.0])
    both = trimesh.util.concatenate([BOX, other])
    both.merge_vertices()
    (line,) = faults(both.vertices, both.faces)
    assert "edges are shared by more than two triangles" in line


def test_vertices_that_are_there_twice():
    seam = BOX.triangles.reshape(-1, 3)
    (line,) = faults(seam, np.arange(36).reshape(-1, 3))
    assert "36 edges of one triangle alone" in line
    assert "merging them would close it" in line
    apart = seam + np.repeat(np.linspace(0, 1e-3, 12), 3)[:, None]
    assert "twice" not in faults(apart, np.arange(36).reshape(-1, 3))[0]


def test_triangles_that_disagree():
    turned = BOX.faces.copy()
    turned[4] = turned[4, ::-1]
    (line,) = faults(BOX.vertices, turned)
    assert "do not agree on which side is outside" in line


def test_triangles_without_area():
    middle = BOX.vertices[BOX.faces[0, :2]].mean(axis=0)
    vertices = np.vstack([BOX.vertices, middle])
    a, b, c = BOX.faces[0]
    split = [[a, 8, c], [8, b, c], [a, b, 8], [a, a, b]]
    line = faults(vertices, np.vstack([split, BOX.faces[1:]]))[0]
    assert line == "the mesh has 2 triangles without area; nothing is heard there"
    thin = [[0.0, 0.0, 0.0], [1.0, 0.0, 0.0], [0.5, 1e-5, 0.0]]
    assert not any("area" in line for line in faults(thin, [[0, 1, 2]]))


def test_inside_out():
    (line,) = faults(BOX.vertices, BOX.faces[:, ::-1])
    assert line == "the mesh is inside out; echoes do not mind, volumes do"


def test_a_million_triangles_take_seconds():
    mesh = trimesh.creation.icosphere(subdivisions=8)
    started = time.process_time()
    assert surface_faults(mesh) == []
    assert time.process_time() - started < 12.0
