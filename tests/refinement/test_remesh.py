# SPDX-License-Identifier: MIT
from __future__ import annotations

import math

import numpy as np
import pytest
import torch
import trimesh

from sononerf.refinement.remesh import MeshOperators, finer, remesh, signed_distance, tangents, unit

EDGE = 2e-3


def ball(radius=0.015, at=(0.0, 0.0, 0.0)):
    mesh = trimesh.creation.icosphere(subdivisions=4, radius=radius)
    mesh.apply_translation(at)
    return mesh


def test_a_sphere_stays_a_sphere_with_edges_as_long_as_asked():
    found = remesh(ball(), EDGE)
    radius = np.linalg.norm(found.vertices, axis=1)
    assert np.abs(radius - 0.015).max() < 1e-4
    assert found.is_watertight
    assert found.volume > 0
    per_vertex = found.area / len(found.vertices)
    assert np.sqrt(per_vertex / np.sqrt(0.75)) == pytest.approx(EDGE, rel=0.1)


def test_overlapping_bodies_become_one_without_walls_inside():
    pair = trimesh.util.concatenate([ball(), ball(at=(0.02, 0.0, 0.0))])
    found = remesh(pair, EDGE)
    assert found.body_count == 1
    # Two spheres less the lens that they share.
    lens = np.pi * (4 * 0.015 + 0.02) * (2 * 0.015 - 0.02) ** 2 / 12
    assert found.volume == pytest.approx(2 * 4 / 3 * np.pi * 0.015**3 - lens, rel=0.02)


@pytest.mark.parametrize("seed", range(3))
def test_a_surface_that_crosses_itself_does_not_empty_the_body(seed):
    mesh = ball()
    vertices = np.array(mesh.vertices)
    top = vertices[:, 2] > 0.012
    shape = int(top.sum()), 3
    vertices[top] += np.random.default_rng(seed).normal(scale=EDGE, size=shape)
    crumpled = trimesh.Trimesh(vertices, mesh.faces, process=False)
    assert remesh(crumpled, EDGE).volume == pytest.approx(ball().volume, rel=0.15)
    finer = remesh(crumpled, EDGE / 2)  # so fine that some crumpled tops are refused
    assert finer is None or finer.volume == pytest.approx(ball().volume, rel=0.15)


def test_a_blur_cuts_a_thin_neck():
    rod = trimesh.creation.cylinder(radius=0.0012, height=0.05, sections=24)
    rod.apply_transform(trimesh.transformations.rotation_matrix(np.pi / 2, [0, 1, 0]))
    rod = rod.subdivide_to_size(0.002)
    rod.merge_vertices()
    whole = trimesh.util.concatenate([ball(at=(-0.03, 0, 0)), ball(at=(0.03, 0, 0)), rod])
    assert remesh(whole, 1e-3).body_count == 1
    assert remesh(whole, 1e-3, blur=0.002).body_count == 2


def test_a_blur_that_would_take_a_wire_away_is_refused():
    wire = trimesh.creation.torus(0.03, 0.0015, major_sections=96, minor_sections=16)
    both = trimesh.util.concatenate([wire, ball(0.008)])
    assert remesh(both, 1e-3).body_count == 2
    assert remesh(both, 1e-3, blur=0.002) is None


def test_open_surfaces_and_sheets_that_would_be_lost_are_left_alone():
    whole = ball()
    half = trimesh.Trimesh(whole.vertices, whole.faces[whole.triangles_center[:, 2] > 0])
    assert remesh(half, EDGE) is None
    sheet = trimesh.creation.box((0.03, 0.03, 0.0002)).subdivide_to_size(0.002)
    sheet.merge_vertices()
    assert remesh(sheet, EDGE) is None


def test_distances_are_signed_and_exact_near_the_surface():
    lower, distance = signed_distance(ball(), 1e-3, margin=4)
    index = np.argwhere(np.abs(distance) < 1e-3)
    wanted = np.linalg.norm(lower + 1e-3 * index, axis=1) - 0.015
    assert np.abs(distance[tuple(index.T)] - wanted).max() < 5e-5
    assert distance[0, 0, 0] > 0
    middle = tuple(np.array(distance.shape) // 2)
    assert distance[middle] < 0


def test_a_finer_mesh_bulges_as_the_surface_does():
    coarse = trimesh.creation.icosphere(subdivisions=2, radius=0.015)
    found, values = finer(coarse, np.arange(len(coarse.vertices), dtype=float), 3.4e-3)
    assert len(found.faces) == 4 * len(coarse.faces)
    assert len(values) == len(found.vertices)
    volume = 4 / 3 * np.pi * 0.015**3
    assert volume - found.volume < 0.35 * (volume - coarse.volume)
    flat = trimesh.creation.box((0.02, 0.02, 0.02))
    for _ in range(6):
        flat = flat.subdivide()
    assert finer(flat, np.zeros(len(flat.vertices)), 3.4e-3)[0] is flat


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
