# SPDX-License-Identifier: MIT
from __future__ import annotations

import numpy as np
import pytest
import torch
import trimesh

from sononerf.run.build import head_of
from sononerf.surface.refine.objective import Level, differences, measured, mismatch
from sononerf.surface.refine.plane_descent import PlaneDescent
from sononerf.surface.refine.planes import motions
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
    """The box in short edges, and the numbers of its faces."""
    found = box.subdivide_to_size(0.6 * optics.wavelength)
    side = np.asarray(box.face_normals)[
        np.unique(box.face_normals.round(6), axis=0, return_index=True)[1]
    ]
    return found, (np.asarray(found.face_normals) @ side.T).argmax(axis=1)


def descent(mesh, part, echoes, optics, rate=1e-4):
    level = Level(optics.ears, len(optics.frequencies), optics.get_buffer("wavenumber"))
    level.learns = "none"
    return PlaneDescent(mesh, part, echoes, optics, level, rate=rate, band=1.0, seed=0)


def error(work, vertices, echoes):
    numbers = list(range(len(echoes.positions)))
    heard = work.render(numbers, vertices)
    found = differences(heard, None, measured(echoes, numbers, heard), work.level, learn=False)
    return mismatch(*found)


def test_a_box_sounds_as_in_the_simulator_and_most_poses_hear_its_edges_alone(fine, heard, optics):
    mesh, part = fine
    work = descent(mesh, part, heard, optics)
    vertices, numbers = torch.as_tensor(work.vertices), list(range(len(heard.positions)))
    with torch.no_grad():
        assert float(error(work, vertices, heard).median()) < 0.5
        whole = work.render(numbers, vertices).power.sum((1, 2, 3))
        work.edges.ends, work.edges.planes = work.edges.ends[:0], work.edges.planes[:0]
        faces = work.render(numbers, vertices).power.sum((1, 2, 3))
    assert float((faces < 1e-3 * whole).float().mean()) > 0.5


def test_gradients_of_edges_are_those_of_differences(fine, heard, optics):
    mesh, part = fine
    work = descent(mesh, part, heard, optics)
    motion = motions(work.vertices, work.faces, work.part)
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


def test_a_box_with_wrong_planes_comes_back(box, fine, heard, optics):
    mesh, part = fine
    motion = motions(np.asarray(mesh.vertices), np.asarray(mesh.faces), part)
    numbers = np.random.default_rng(1).normal(0.0, 3e-4, 18)
    off = np.asarray(mesh.vertices) + (motion @ numbers).reshape(-1, 3)
    work = descent(trimesh.Trimesh(off, mesh.faces, process=False), part, heard, optics)
    away = [np.linalg.norm(work.vertices - mesh.vertices, axis=1).mean()]
    errors = [work.step(number, number / 30) for number in range(30)]
    away.append(np.linalg.norm(work.vertices - mesh.vertices, axis=1).mean())
    assert away[1] < 0.3 * away[0]
    assert np.mean(errors[-3:]) < 0.3 * np.mean(errors[:3])


def test_a_step_depends_on_the_state_alone(fine, heard, optics):
    mesh, part = fine
    work = descent(mesh, part, heard, optics)
    work.step(0, 0.0)
    again = descent(mesh, part, heard, optics)
    again.load(work.state())
    again.level.load(work.level.state())
    for one in (work, again):
        one.step(1, 0.1)
    assert np.array_equal(work.vertices, again.vertices)
