# SPDX-License-Identifier: MIT
from __future__ import annotations

import numpy as np
import pytest
import torch
import trimesh

from sononerf.refinement.descent import Walls
from sononerf.refinement.objective import ErrorLevel, differences, measured, mismatch
from sononerf.refinement.plane_descent import PlaneDescent, flattest
from sononerf.refinement.planes import flat_parts, motions, on_patches, patches_of, planes_of
from sononerf.refinement.remesh import distance_from
from sononerf.run.simulate import head_of
from tests.memory import deaf_hull, echoes_of

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


TOLERANCE = 1e-3
LEAST = 5e-5


def test_a_worn_box_has_its_six_faces(turned_box, worn):
    part = flat_parts(worn, TOLERANCE, LEAST)
    normal, offset = planes_of(worn, part, TOLERANCE)
    assert len(normal) == 6
    alike = normal @ np.asarray(turned_box.facets_normal).T
    assert np.degrees(np.arccos(alike.max(axis=1))).max() < 1.0
    wanted = np.asarray(turned_box.facets_origin) * np.asarray(turned_box.facets_normal)
    assert np.allclose(offset, wanted.sum(axis=1)[alike.argmax(axis=1)], atol=2e-4)


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


def test_the_sides_of_a_thin_plate_stay_apart():
    plate = trimesh.creation.box((0.05, 0.04, 1e-3)).subdivide_to_size(2e-3)
    part = flat_parts(plate, TOLERANCE, LEAST)
    up = np.asarray(plate.face_normals)[:, 2]
    assert not set(part[up > 0.9]) & set(part[up < -0.9])


def test_a_smooth_body_has_many_parts():
    ball = trimesh.creation.icosphere(subdivisions=4, radius=0.03)
    assert flat_parts(ball, 3e-4, 0.0).max() > 20


SIDES = (0.05, 0.04, 0.03)


@pytest.fixture(scope="module")
def box():
    found = trimesh.creation.box(SIDES)
    found.apply_transform(trimesh.transformations.euler_matrix(0.3, 0.8, 1.9))
    return found


@pytest.fixture(scope="module")
def heard(box, settings, poses, simulated):
    head, at = head_of(settings), (poses.positions, poses.rotations)
    found = simulated(box, settings, poses)
    return echoes_of(head, *at, lambda i: found[i], hull=deaf_hull())


@pytest.fixture(scope="module")
def fine(box, optics):
    """The box in short edges."""
    return box.subdivide_to_size(0.6 * optics.wavelength)


def descent(mesh, echoes, optics, band=1.0):
    level = ErrorLevel(optics.ears, len(optics.frequencies), optics.get_buffer("wavenumber"))
    level.learns = "none"
    return PlaneDescent(mesh, echoes, optics, level, rate=0.08, band=band, seed=0)


def distance(mesh, places):
    return distance_from(mesh, places, 1e-3).mean()


def error(work, vertices, echoes):
    numbers = list(range(len(echoes.positions)))
    heard = work.render(numbers, vertices)
    found = differences(heard, None, measured(echoes, numbers, heard), work.level, learn=False)
    return mismatch(*found)


def test_a_box_sounds_as_in_the_simulator_and_most_poses_hear_its_edges_alone(fine, heard, optics):
    work = descent(fine, heard, optics)
    vertices, numbers = torch.as_tensor(work.vertices), list(range(len(heard.positions)))
    with torch.no_grad():
        assert float(error(work, vertices, heard).median()) < 0.5
        whole = work.render(numbers, vertices).power.sum((1, 2, 3))
        work.edges.ends, work.edges.planes = work.edges.ends[:0], work.edges.planes[:0]
        faces = work.render(numbers, vertices).power.sum((1, 2, 3))
    assert float((faces < 1e-3 * whole).float().mean()) > 0.5


def test_gradients_of_edges_are_those_of_differences(fine, heard, optics):
    work = descent(fine, heard, optics)
    motion = motions(work.vertices, work.faces, work.part, work.patches, 3)
    start = work.vertices + (motion @ np.tile([3e-4, 2e-4, -2e-4], 6)).reshape(-1, 3)
    vertices = torch.as_tensor(start).requires_grad_(True)
    error(work, vertices, heard).mean().backward()
    wanted = []
    for number in range(1, 18, 3):  # tilts, by which the edges' levels change
        way = 1e-5 * (motion @ np.eye(18)[number]).reshape(-1, 3)
        with torch.no_grad():
            ends = [
                float(error(work, torch.as_tensor(start + sign * way), heard).mean())
                for sign in (1, -1)
            ]
        wanted.append((ends[0] - ends[1]) / 2e-5)
    found = (motion.T @ vertices.grad.numpy().ravel())[1::3]
    assert np.linalg.norm(found - wanted) < 0.1 * np.linalg.norm(wanted)


@pytest.mark.slow
def test_a_box_with_wrong_planes_and_worn_edges_comes_back(fine, heard, optics):
    begun = descent(fine, heard, optics)
    motion = motions(begun.vertices, begun.faces, begun.part, begun.patches, 3)
    numbers = np.random.default_rng(1).normal(0.0, 3e-4, 18)
    off = np.asarray(fine.vertices) + (motion @ numbers).reshape(-1, 3)
    worn = trimesh.smoothing.filter_laplacian(
        trimesh.Trimesh(off, fine.faces, process=False), iterations=2
    )
    work = descent(worn, heard, optics)
    assert work.part.max() == 5
    away = [distance(fine, work.vertices)]
    errors = [work.step(number, number / 40) for number in range(40)]
    away.append(distance(fine, work.vertices))
    assert away[1] < 0.3 * away[0]
    assert np.mean(errors[-3:]) < 0.3 * np.mean(errors[:3])


def test_of_surfaces_the_one_that_is_best_on_planes_is_chosen(fine, optics):
    worn = trimesh.smoothing.filter_laplacian(fine.copy(), iterations=3)
    ball = trimesh.creation.icosphere(subdivisions=4, radius=0.02)
    open_box = trimesh.Trimesh(fine.vertices, fine.faces[1:], process=False)

    def error(mesh):
        return distance(fine, mesh.vertices)

    more = trimesh.smoothing.filter_laplacian(fine.copy(), iterations=6)
    assert flattest([open_box, more, worn, ball], error, optics) is worn
    assert flattest([open_box], error, optics) is None

    def from_ball(mesh):
        return np.abs(np.linalg.norm(mesh.vertices, axis=1) - 0.02).mean()

    assert flattest([ball, worn], from_ball, optics) is None


THICK = 1e-3


@pytest.fixture
def plate():
    mesh = trimesh.creation.box((0.02, 0.02, THICK))
    for _ in range(4):
        mesh = mesh.subdivide()
    return mesh


def moved(plate, least, shift):
    """A plate whose upper side was moved by so much, after its sides were kept apart."""
    walls = Walls(plate, least)
    vertices = torch.as_tensor(np.array(plate.vertices))
    upper = (vertices[:, 2] > 0).double()[:, None]
    vertices = vertices + upper * torch.tensor([0.0, 0.0, shift])
    normals = torch.as_tensor(np.array(plate.vertex_normals))
    return vertices, walls.apart(vertices, normals)


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
    assert torch.equal(Walls(ball, 1.0).apart(vertices, normals), vertices)
