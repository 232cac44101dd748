# SPDX-License-Identifier: MIT
from __future__ import annotations

import numpy as np
import pytest
import torch
import trimesh

from sononerf.run.build import head_of
from sononerf.surface.refine.objective import Level, differences, measured, mismatch
from sononerf.surface.refine.patches import motions
from sononerf.surface.refine.plane_descent import PlaneDescent, flattest
from sononerf.surface.refine.remesh import distance_from
from tests.memory import deaf_hull, echoes_of

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
    level = Level(optics.ears, len(optics.frequencies), optics.get_buffer("wavenumber"))
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
