# SPDX-License-Identifier: MIT
from __future__ import annotations

import numpy as np
import pytest
import trimesh

from sononerf.surface.refine.patches import motions, on_patches, patches_of
from sononerf.surface.refine.planes import flat_parts
from tests.surface.refine.test_planes import LEAST, TOLERANCE

FAR = 5e-3


def put(mesh, part, patches, far=FAR):
    return on_patches(mesh, part, patches, np.asarray(mesh.vertices), far)


@pytest.fixture(scope="module")
def flat(worn):
    """The worn box on planes, its parts, and the planes."""
    part = flat_parts(worn, TOLERANCE, LEAST)
    patches = patches_of(worn, part, TOLERANCE, bent=False)
    return put(worn, part, patches), part, patches


def test_a_worn_box_has_its_corners_again(turned_box, worn, flat):
    found, _, _ = flat
    corners = np.asarray(turned_box.vertices)[:, None]
    away = np.linalg.norm(corners - np.asarray(found.vertices), axis=2).min(axis=1)
    before = np.linalg.norm(corners - np.asarray(worn.vertices), axis=2).min(axis=1)
    assert away.max() < 0.4e-3 < before.min()
    assert found.is_watertight
    assert found.volume == pytest.approx(turned_box.volume, rel=0.02)


def test_no_vertex_of_an_edge_goes_farther_than_it_may(worn, flat):
    _, part, patches = flat
    found = put(worn, part, patches, far=5e-4)
    moved = np.linalg.norm(found.vertices - worn.vertices, axis=1)
    edges = np.unique(worn.face_adjacency_edges[np.ptp(part[worn.face_adjacency], axis=1) > 0])
    assert moved[edges].max() < 5.001e-4
    free = np.linalg.norm(flat[0].vertices - worn.vertices, axis=1)
    assert free[edges].max() > 1e-3


def test_planes_move_and_tilt_what_lies_on_them_and_keep_it_flat(flat):
    found, part, patches = flat
    places, faces = np.asarray(found.vertices), np.asarray(found.faces)
    motion = motions(places, faces, part, patches, 3)
    numbers = np.random.default_rng(0).normal(0.0, 2e-4, 18)
    moved = places + (motion @ numbers).reshape(-1, 3)
    for one in range(6):
        own = moved[np.unique(faces[part == one])]
        off = np.linalg.svd(own - own.mean(axis=0), compute_uv=False)[2] / np.sqrt(len(own))
        assert off < 2e-5
    only = np.zeros(18)
    only[0] = 1e-4
    shift = (motion @ only).reshape(-1, 3)
    inside = np.setdiff1d(faces[part == 0], faces[part != 0])
    assert np.allclose(shift[inside], 1e-4 * patches.axes[0, 2], rtol=0.05, atol=1e-6)
    assert np.abs(shift[np.setdiff1d(faces, faces[part == 0])]).max() == 0.0


def test_vertices_on_edges_follow_all_of_their_planes():
    axes = np.concatenate([np.eye(3), -np.eye(3)])
    body = trimesh.convex.convex_hull(0.03 * axes)  # an octahedron: its planes are not square
    fine = body.subdivide_to_size(3e-3)
    normal = np.asarray(body.face_normals)
    part = (np.asarray(fine.face_normals) @ normal.T).argmax(axis=1)
    places, faces = np.asarray(fine.vertices), np.asarray(fine.faces)
    motion = motions(places, faces, part, patches_of(fine, part, TOLERANCE, bent=False), 3)
    shift = (motion @ np.tile([1e-4, 0.0, 0.0], 8)).reshape(-1, 3)
    height = np.einsum("tcd,td->tc", shift[faces], normal[part])
    assert np.allclose(height, 1e-4, rtol=0.06)
    assert np.linalg.matrix_rank(motion[:, :3].toarray()) == 3


def bulged(box):
    """Return a box whose faces bulge by up to a millimetre, and the parts."""
    fine = box.subdivide_to_size(2e-3)
    part = (np.asarray(fine.face_normals) @ np.asarray(box.facets_normal).T).argmax(axis=1)
    places = np.asarray(fine.vertices)
    off = (places @ np.asarray(box.facets_normal).T) / np.asarray(box.extents).max()
    bulge = 1e-3 * (1.0 - np.square(places / np.abs(places).max(axis=0)).mean(axis=1))
    moved = places + bulge[:, None] * np.sign(off.max(axis=1))[:, None] * fine.vertex_normals
    return trimesh.Trimesh(moved, fine.faces, process=False), part


def test_bent_faces_are_found():
    mesh, part = bulged(trimesh.creation.box((0.06, 0.04, 0.03)))
    errors = []
    for bent in (False, True):
        patches = patches_of(mesh, part, TOLERANCE, bent=bent)
        errors.append(np.abs(patches.off(part, np.asarray(mesh.triangles_center))).mean())
        found = put(mesh, part, patches)
        inside = np.setdiff1d(mesh.faces[part == 0], mesh.faces[part != 0])
        height = patches.off(np.zeros(len(inside), dtype=int), found.vertices[inside])
        assert np.abs(height).max() < 1e-5
    assert errors[1] < 0.3 * errors[0]


def test_normals_are_those_of_the_heights():
    mesh, part = bulged(trimesh.creation.box((0.06, 0.04, 0.03)))
    patches = patches_of(mesh, part, TOLERANCE, bent=True)
    places, step = np.asarray(mesh.triangles_center), 1e-6
    way = step * np.eye(3)
    slope = [
        (patches.off(part, places + one) - patches.off(part, places - one)) / (2 * step)
        for one in way
    ]
    found = np.stack(slope, axis=1)
    found /= np.linalg.norm(found, axis=1, keepdims=True)
    assert np.allclose(found, patches.normals(part, places), atol=1e-6)


def test_paraboloids_bend_what_lies_on_them(flat):
    found, part, patches = flat
    places, faces = np.asarray(found.vertices), np.asarray(found.faces)
    numbers = np.zeros((6, 6))
    numbers[0, 3:] = (1e-4, 5e-5, -1e-4)
    motion = motions(places, faces, part, patches, 6)
    moved = places + (motion @ numbers.ravel()).reshape(-1, 3)
    inside = np.setdiff1d(faces[part == 0], faces[part != 0])
    bent = patches_of(trimesh.Trimesh(moved, faces, process=False), part, TOLERANCE, bent=True)
    of = np.zeros(len(inside), dtype=int)
    assert (
        np.abs(bent.off(of, moved[inside])).mean()
        < 0.1 * np.abs(patches.off(of, moved[inside])).mean()
    )
