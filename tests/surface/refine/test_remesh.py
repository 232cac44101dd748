# SPDX-License-Identifier: MIT
from __future__ import annotations

import numpy as np
import pytest
import trimesh

from sononerf.surface.refine.remesh import finer, remesh, signed_distance

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
