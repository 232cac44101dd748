# SPDX-License-Identifier: MIT
import time

import numpy as np
import pytest
import trimesh

from sononerf.geometry import faults
from sononerf.geometry.faults import surface_faults

BOX = trimesh.creation.box((1.0, 1.0, 1.0))


def ball(radius, centre=(0.0, 0.0, 0.0)):
    mesh = trimesh.creation.icosphere(subdivisions=3, radius=radius)
    mesh.apply_translation(centre)
    return mesh


def said(*meshes):
    mesh = trimesh.util.concatenate(meshes)
    return surface_faults(mesh.vertices, mesh.faces)


@pytest.mark.parametrize(
    "meshes",
    [
        (BOX,),
        (ball(1.0), ball(1.0, (1.2, 0.1, 0.0))),
        (ball(1.0), ball(0.5, (0.8, 0.0, 0.0))),  # pokes out
        (trimesh.creation.torus(2.0, 0.5), ball(0.4)),  # in its hole
        tuple(ball(1.0, (2.5 * k, 0, 0)) for k in range(5)),
    ],
)
def test_good_surfaces_are_passed_over(meshes):
    assert said(*meshes) == []


def test_open():
    (line,) = surface_faults(BOX.vertices, BOX.faces[:-1])
    assert line == (
        "the mesh is open (3 edges of one triangle alone); volumes will not be measured"
    )


def test_edges_of_more_than_two_triangles():
    other = BOX.copy()
    other.apply_translation([1.0, 1.0, 0.0])
    both = trimesh.util.concatenate([BOX, other])
    both.merge_vertices()
    (line,) = surface_faults(both.vertices, both.faces)
    assert "1 edge shared by more than two triangles" in line
    assert not both.is_watertight


def test_vertices_that_stand_twice():
    seam = BOX.triangles.reshape(-1, 3)
    (line,) = surface_faults(seam, np.arange(36).reshape(-1, 3))
    assert "36 edges" in line
    assert "28 of their 36 vertices stand twice, merging would close it" in line
    (line,) = surface_faults(seam[:-3], np.arange(33).reshape(-1, 3))
    assert "merging would leave 3 of them" in line
    apart = seam + np.repeat(np.linspace(0, 1e-3, 12), 3)[:, None]
    assert "twice" not in surface_faults(apart, np.arange(36).reshape(-1, 3))[0]


def test_triangles_that_disagree():
    turned = BOX.faces.copy()
    turned[4] = turned[4, ::-1]
    (line,) = surface_faults(BOX.vertices, turned)
    assert "do not agree on which side is outside (3 edges" in line


def test_triangles_without_area():
    middle = BOX.vertices[BOX.faces[0, :2]].mean(axis=0)
    vertices = np.vstack([BOX.vertices, middle])
    a, b, c = BOX.faces[0]
    split = [[a, 8, c], [8, b, c], [a, b, 8], [a, a, b]]
    lines = surface_faults(vertices, np.vstack([split, BOX.faces[1:]]))
    assert lines == ["the mesh has 2 triangles without area; nothing is heard there"]
    # single precision does not hide it
    rough = vertices.astype(np.float32) / np.float32(3.0) + np.float32(0.7)
    assert surface_faults(rough, [[a, b, 8]])[0].startswith("the mesh has 1 triangle without")
    thin = [[0.0, 0.0, 0.0], [1.0, 0.0, 0.0], [0.5, 1e-5, 0.0]]
    assert not any("area" in line for line in surface_faults(thin, [[0, 1, 2]]))
    assert surface_faults(np.zeros((3, 3)), [[0, 0, 0]])[0].startswith("the mesh has 1 triangle")


def inverted(mesh):
    return trimesh.Trimesh(mesh.vertices, mesh.faces[:, ::-1], process=False)


def test_inside_out():
    assert said(inverted(BOX)) == ["the mesh is inside out; echoes do not mind, volumes do"]
    far = ball(1.0, (5.0, 0.0, 0.0))
    (line,) = said(BOX, inverted(far))
    assert line.startswith("1 of the mesh's 2 bodies is inside out")
    sheet = trimesh.Trimesh(
        [[0, 0, 0], [1, 0, 0], [0, 1, 0]], [[0, 1, 2], [0, 2, 1]], process=False
    )
    assert said(sheet) == []  # two-sided, and without an inside


def test_one_body_inside_another():
    (line,) = said(ball(1.0), ball(0.5, (0.3, 0.0, 0.0)))
    assert line.startswith("1 of the mesh's 2 bodies lies wholly inside another")
    (line,) = said(ball(1.0), ball(0.2, (0.3, 0, 0)), ball(0.2, (-0.3, 0, 0)), ball(0.1, (3, 0, 0)))
    assert line.startswith("2 of the mesh's 4 bodies lie wholly inside another")
    (line,) = said(ball(1.0), inverted(ball(0.5)))  # a hollow is no body inside out
    assert line.startswith("1 of the mesh's 2 bodies lies wholly inside")
    lines = said(inverted(ball(1.0)), inverted(ball(0.5)))
    assert [line.split(";")[0] for line in lines] == [
        "2 of the mesh's 2 bodies are inside out",
        "1 of the mesh's 2 bodies lies wholly inside another",
    ]


def test_only_the_largest_bodies_are_searched(monkeypatch):
    monkeypatch.setattr(faults, "MOST_BODIES", 1)
    (line,) = said(ball(0.5, (5, 0, 0)), ball(0.2, (5, 0, 0)), ball(1.0), ball(0.2))
    assert line.startswith("1 of the mesh's 4")


def test_vertices_that_no_triangle_names_do_not_matter():
    vertices = np.vstack([[[9.0, 9.0, 9.0]], BOX.vertices])
    assert surface_faults(vertices, BOX.faces + 1) == []


def test_a_million_triangles_take_seconds():
    mesh = trimesh.creation.icosphere(subdivisions=8)
    started = time.process_time()
    assert surface_faults(mesh.vertices, mesh.faces) == []
    assert time.process_time() - started < 8.0  # 1.3 s alone on a core
