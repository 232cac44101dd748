# SPDX-License-Identifier: MIT
import time

import numpy as np
import pytest
import trimesh

from sononerf.geometry.meshes import (
    bodies,
    corner_normals,
    enclosing_balls,
    surface_faults,
    total_curvature,
    weight_gradients,
)


@pytest.mark.parametrize("subdivisions", [1, 3])
def test_normals_of_a_sphere_are_exact(subdivisions):
    mesh = trimesh.creation.icosphere(subdivisions=subdivisions, radius=0.02)
    mesh.apply_translation([1.0, 2.0, 3.0])
    expected = (mesh.triangles - [1.0, 2.0, 3.0]) / 0.02
    # Subdivision 1 has 18 degrees between triangles, below the crease.
    np.testing.assert_allclose(corner_normals(mesh), expected, atol=1e-6)


def test_a_box_keeps_its_edges():
    mesh = trimesh.creation.box((1.0, 2.0, 3.0))
    expected = np.repeat(mesh.face_normals[:, None], 3, axis=1)
    np.testing.assert_allclose(corner_normals(mesh), expected, atol=1e-12)


def test_a_triangle_without_area_spoils_nothing():
    vertices = [[0, 0, 0], [1, 0, 0], [0, 1, 0], [0.5, 0, 0]]
    mesh = trimesh.Trimesh(vertices, [[0, 1, 2], [0, 3, 1]], process=False)
    normals = corner_normals(mesh)
    assert np.isfinite(normals).all()
    np.testing.assert_allclose(normals[0], [[0, 0, 1]] * 3, atol=1e-12)


def curvature(mesh):
    return total_curvature(mesh, corner_normals(mesh))


@pytest.mark.parametrize("radius", [0.002, 0.015, 15.0])  # the same ball in m, or taken for mm
def test_curvature_of_a_sphere_is_root_two_over_its_radius(radius):
    mesh = trimesh.creation.icosphere(subdivisions=4, radius=radius)
    mesh.apply_translation([3.0 * radius, 0.0, 0.0])
    # A triangle is flatter than the sphere between its corners: chords, up to 0.2 %.
    np.testing.assert_allclose(curvature(mesh), np.sqrt(2) / radius, rtol=2e-3)


def test_curvature_of_a_cylinder_is_one_over_its_radius_and_none_at_its_ends():
    mesh = trimesh.creation.cylinder(radius=0.02, height=0.1, sections=90)
    found = curvature(mesh)
    side = np.abs(mesh.face_normals[:, 2]) < 0.5
    # 90 flat strips of 4 degrees: the chord is shorter than the arc by 2e-4.
    np.testing.assert_allclose(found[side], 1 / 0.02, rtol=1e-3)
    np.testing.assert_allclose(found[~side], 0.0, atol=1e-6)


def test_edges_of_a_box_are_no_curvature():
    np.testing.assert_allclose(curvature(trimesh.creation.box((0.1, 0.2, 0.3))), 0.0, atol=1e-9)


def test_weight_gradients_give_the_barycentric_weights():
    corners = np.random.default_rng(0).normal(size=(50, 3, 3))
    second, third = weight_gradients(corners)
    for corner, weights in enumerate([(0, 0), (1, 0), (0, 1)]):
        away = corners[:, corner] - corners[:, 0]
        np.testing.assert_allclose(np.einsum("td,td->t", second, away), weights[0], atol=1e-9)
        np.testing.assert_allclose(np.einsum("td,td->t", third, away), weights[1], atol=1e-9)
    # In the triangle's plane: going off it changes nothing.
    sides = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    for gradient in (second, third):
        np.testing.assert_allclose(np.einsum("td,td->t", gradient, sides), 0.0, atol=1e-9)


def test_a_triangle_without_area_has_no_gradients_and_no_curvature():
    vertices = [[0, 0, 0], [1, 0, 0], [0, 1, 0], [0.5, 0, 0]]
    mesh = trimesh.Trimesh(vertices, [[0, 1, 2], [0, 3, 1]], process=False)
    for gradient in weight_gradients(mesh.triangles.view(np.ndarray)):
        np.testing.assert_array_equal(gradient[1], 0.0)
    assert np.isfinite(curvature(mesh)).all()
    assert curvature(mesh)[1] == 0.0


def spheres_in_a_row(count):
    parts = [trimesh.creation.icosphere(subdivisions=2, radius=0.5) for _ in range(count)]
    for number, part in enumerate(parts):
        part.apply_translation([float(number), 0.0, 0.0])
    return trimesh.util.concatenate(parts)


@pytest.mark.parametrize("count", [1, 2, 3, 32])
def test_balls_hold_every_corner(count):
    for mesh in (spheres_in_a_row(3), trimesh.creation.box((0.01, 1.0, 2.0)).subdivide()):
        centres, radii = enclosing_balls(mesh.triangles, bodies(mesh), count)
        assert len(radii) <= count
        away = np.linalg.norm(np.asarray(mesh.vertices)[:, None] - centres, axis=2)
        assert (away <= radii * (1 + 1e-12)).any(axis=1).all()


def test_a_ball_is_no_larger_than_its_body():
    mesh = spheres_in_a_row(3)
    assert len(np.unique(bodies(mesh))) == 3
    centres, radii = enclosing_balls(mesh.triangles, bodies(mesh), 32)
    np.testing.assert_allclose(radii, 0.5, rtol=1e-6)
    np.testing.assert_allclose(np.sort(centres[:, 0]), [0.0, 1.0, 2.0], atol=1e-6)


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


@pytest.mark.slow
def test_a_million_triangles_take_seconds():
    mesh = trimesh.creation.icosphere(subdivisions=8)
    started = time.process_time()
    assert surface_faults(mesh) == []
    assert time.process_time() - started < 12.0
