# SPDX-License-Identifier: MIT
from __future__ import annotations

import numpy as np
import pytest
import trimesh

from sononerf.surface.refine.planes import flat_parts, motions, on_planes, planes_of
from sononerf.surface.refine.remesh import remesh

SIDES = (0.06, 0.04, 0.03)
EDGE = 1.5e-3
TOLERANCE = 1e-3
LEAST = 5e-5


@pytest.fixture(scope="module")
def box():
    found = trimesh.creation.box(SIDES)
    turn = trimesh.transformations.euler_matrix(0.3, 0.8, 1.9)
    return found.apply_transform(turn)


@pytest.fixture(scope="module")
def worn(box):
    """A box with rounded edges, and waves of half a millimetre on its faces."""
    found = remesh(box.subdivide_to_size(2e-3), EDGE, 1.5e-3)
    places = np.asarray(found.vertices)
    wave = 4e-4 * np.sin(places @ np.array([250.0, 120.0, 90.0]))
    moved = places + wave[:, None] * np.asarray(found.vertex_normals)
    return trimesh.Trimesh(moved, found.faces, process=False)


def put(mesh):
    part = flat_parts(mesh, TOLERANCE, LEAST)
    return on_planes(mesh, part, *planes_of(mesh, part, TOLERANCE)), part


def test_a_worn_box_has_its_six_faces_and_its_corners_again(box, worn):
    found, part = put(worn)
    assert part.max() + 1 == 6
    corners = np.asarray(box.vertices)[:, None]
    away = np.linalg.norm(corners - np.asarray(found.vertices), axis=2).min(axis=1)
    before = np.linalg.norm(corners - np.asarray(worn.vertices), axis=2).min(axis=1)
    assert away.max() < 0.4e-3 < before.min()
    assert found.is_watertight
    assert found.volume == pytest.approx(box.volume, rel=0.02)


def test_the_parts_do_not_depend_on_where_the_box_lies(worn):
    turned = worn.copy().apply_translation([0.3, -0.2, 0.1])
    first, second = (flat_parts(mesh, TOLERANCE, LEAST) for mesh in (worn, turned))
    assert len(np.unique(np.stack([first, second], axis=1), axis=0)) == first.max() + 1


def test_small_parts_are_given_away(worn):
    many = flat_parts(worn, 0.2 * TOLERANCE, 0.0)
    fewer = flat_parts(worn, 0.2 * TOLERANCE, LEAST)
    area = np.bincount(fewer, worn.area_faces)
    assert fewer.max() < many.max()
    assert area.min() >= LEAST


def test_planes_move_and_tilt_what_lies_on_them_and_keep_it_flat(worn):
    found, part = put(worn)
    places, faces = np.asarray(found.vertices), np.asarray(found.faces)
    numbers = np.random.default_rng(0).normal(0.0, 2e-4, 18)
    moved = places + (motions(places, faces, part) @ numbers).reshape(-1, 3)
    for one in range(6):
        own = moved[np.unique(faces[part == one])]
        off = np.linalg.svd(own - own.mean(axis=0), compute_uv=False)[2] / np.sqrt(len(own))
        assert off < 2e-5
    only = np.zeros(18)
    only[0] = 1e-4
    shift = (motions(places, faces, part) @ only).reshape(-1, 3)
    inside = np.setdiff1d(faces[part == 0], faces[part != 0])
    normal = planes_of(found, part, TOLERANCE)[0][0]
    assert np.allclose(shift[inside], 1e-4 * normal, rtol=0.05, atol=1e-6)
    assert np.abs(shift[np.setdiff1d(faces, faces[part == 0])]).max() == 0.0


def test_vertices_on_edges_follow_all_of_their_planes():
    axes = np.concatenate([np.eye(3), -np.eye(3)])
    body = trimesh.convex.convex_hull(0.03 * axes)  # an octahedron: its planes are not square
    fine = body.subdivide_to_size(3e-3)
    normal = np.asarray(body.face_normals)
    part = (np.asarray(fine.face_normals) @ normal.T).argmax(axis=1)
    places, faces = np.asarray(fine.vertices), np.asarray(fine.faces)
    motion = motions(places, faces, part)
    outward = np.tile([1e-4, 0.0, 0.0], 8)
    shift = (motion @ outward).reshape(-1, 3)
    height = np.einsum("tcd,td->tc", shift[faces], normal[part])
    assert np.allclose(height, 1e-4, rtol=0.06)
    assert np.linalg.matrix_rank(motion[:, :3].toarray()) == 3


def test_the_sides_of_a_thin_plate_stay_apart():
    plate = trimesh.creation.box((0.05, 0.04, 1e-3)).subdivide_to_size(2e-3)
    part = flat_parts(plate, TOLERANCE, LEAST)
    up = np.asarray(plate.face_normals)[:, 2]
    assert not set(part[up > 0.9]) & set(part[up < -0.9])


def test_a_smooth_body_has_many_parts():
    ball = trimesh.creation.icosphere(subdivisions=4, radius=0.03)
    assert flat_parts(ball, 3e-4, 0.0).max() > 20
