# SPDX-License-Identifier: MIT
from __future__ import annotations

import numpy as np
import pytest
import torch
import trimesh

from sononerf.geometry.raycast import Occlusion
from sononerf.refinement.descent import Descent
from sononerf.refinement.objective import ErrorLevel, differences, measured, mismatch
from sononerf.refinement.remesh import remesh
from sononerf.refinement.tracer import FREE_DISTANCE, Correction, StillSurface, Tracer, seen
from sononerf.run.simulate import simulator_of
from sononerf.scene.scene import Scene
from tests.memory import changed
from tests.refinement.conftest import RADIUS


def test_what_stands_before_a_point_hides_it_but_not_what_touches_it():
    wall = trimesh.creation.box((0.001, 0.1, 0.1))
    sight = Occlusion(np.asarray(wall.vertices), np.asarray(wall.faces))
    points = np.array([[-0.05, 0.0, 0.0], [-0.001, 0.0, 0.0], [0.05, 0.0, 0.0]])
    target = np.broadcast_to([0.3, 0.0, 0.0], points.shape)
    assert seen(sight, points, target, free=0.005).tolist() == [False, True, True]
    assert seen(sight, points, target, free=0.0).tolist() == [False, False, True]


def heard(optics, mesh, at):
    surface = StillSurface(mesh, optics)
    pieces, _, _ = surface.listen(np.array([at]), np.diag([-1.0, -1.0, 1.0])[None])
    return surface.vertices[pieces.vertex].numpy(), pieces


def test_a_body_hides_the_one_behind_it(optics, ball):
    other = ball.copy()
    other.apply_translation([-0.05, 0.0, 0.0])
    places, pieces = heard(optics, trimesh.util.concatenate([ball, other]), [0.3, 0.0, 0.0])
    assert (places[:, 0] > 0).all()
    assert float(pieces.weight.min()) >= 0.0
    alone, _ = heard(optics, other, [0.3, 0.0, 0.0])
    assert len(alone) > 20


def test_the_other_side_of_a_sheet_pushed_through_hides_nothing(optics):
    sheet = trimesh.creation.box((0.0005, 0.03, 0.03))
    for _ in range(4):
        sheet = sheet.subdivide()
    vertices = np.array(sheet.vertices)
    front = vertices[:, 0] > 0
    vertices[front, 0] -= FREE_DISTANCE * optics.wavelength  # now behind the other side
    crossed = trimesh.Trimesh(vertices, sheet.faces, process=False)
    places, _ = heard(optics, crossed, [0.3, 0.0, 0.0])
    assert len(places) > 50


@pytest.mark.parametrize(("stretch", "late"), [(1.0, 0.02), (1.03, 0.0)])
def test_longer_paths_are_heard_later(optics, ball, poses, stretch, late):
    surface, at = StillSurface(ball, optics), (poses.positions, poses.rotations)
    one = np.ones(len(poses.positions))
    before, after = surface.render(*at), surface.render(*at, stretch * one, late * one)
    ranges = optics.head.range[:, None]
    first, later = (
        (ranges * part**2).sum(axis=(1, 2, 3)) / (part**2).sum(axis=(1, 2, 3))
        for part in (before, after)
    )
    assert later == pytest.approx(first * stretch + late / 2, abs=1e-3)


@pytest.mark.parametrize("part", [0.5, 1.5])
def test_poses_off_the_axis_hear_nothing(optics, ball, poses, part):
    assert not StillSurface(ball, optics).render(part * poses.positions, poses.rotations).any()


def test_one_convex_body_has_no_later_bounces_and_two_have(optics, ball, poses):
    one = Tracer(optics, ball, rays=2000, seed=0)
    other = ball.copy()
    other.apply_translation([0.0, 2.5 * RADIUS, 0.0])
    two = Tracer(optics, trimesh.util.concatenate([ball, other]), rays=4000, seed=0)
    head = np.array([0.3, 0.0, 0.0]), np.diag([-1.0, -1.0, 1.0])
    assert len(one.later(*head).delay) == 0
    later = two.later(*head)
    assert len(later.delay) > 10
    assert later.weight.shape == (len(later.ear), len(optics.kept_nodes))
    # Out, across the gap and back.
    assert later.delay.min() * optics.speed_of_sound > 2 * (0.3 - 2 * RADIUS)


def test_a_tracer_hears_what_the_simulator_hears(optics, echoes, ball):
    fine = trimesh.creation.icosphere(subdivisions=5, radius=RADIUS)
    tracer = Tracer(optics, fine, rays=20_000, seed=0)
    (found,) = tracer.spectrograms(echoes.positions[:1], echoes.rotations[:1])
    wanted = echoes.magnitude(0).numpy()
    assert np.allclose(found, wanted, atol=0.02 * wanted.max())


POSES = [3, 7]


class Shifted:
    """A simulator that hears everything twice as loud as another one."""

    def __init__(self, simulator):
        self.simulator, self.rays, self.low = simulator, simulator.rays, simulator.low

    def spectrogram(self, position, rotation, *, seed):
        return 2.0 * self.simulator.spectrogram(position, rotation, seed=seed)


@pytest.fixture(scope="module")
def sphere(ball):
    return remesh(ball, 2.5e-3)


@pytest.fixture(scope="module")
def simulator(settings, sphere):
    return simulator_of(Scene(sphere), settings)


@pytest.fixture
def correction(optics, sphere, simulator, echoes):
    return Correction(optics, sphere, simulator, echoes, echoes.training, seed=0)


@pytest.fixture
def level(optics):
    found = ErrorLevel(optics.ears, len(optics.frequencies), optics.get_buffer("wavenumber"))
    found.learns = "none"
    return found


def heard_of(sphere, echoes, optics, level):
    """What is rendered of the surface itself for the poses."""
    work = Descent(sphere, echoes, optics, level, smoothing=optics.wavelength, rate=0.02, seed=0)
    return work.render(POSES)[0]


def test_both_sides_are_of_the_same_surface(correction, sphere, echoes, optics, level):
    heard = heard_of(sphere, echoes, optics, level)
    simulated, rendered = correction.magnitudes(POSES, heard)
    assert simulated.shape == rendered.shape == heard.power.shape
    expected = heard.power.sqrt().detach()
    tolerance = 1e-4 * float(expected.max())
    torch.testing.assert_close(rendered, expected, rtol=1e-4, atol=tolerance)
    loud = simulated > 0.3 * simulated.amax()
    ratio = 20 * torch.log10(simulated[loud] / rendered[loud])
    assert ratio.abs().median() < 1.5  # decibels


def test_on_the_surface_itself_the_corrected_echo_is_the_simulated_one(
    correction, sphere, echoes, optics, level
):
    heard = heard_of(sphere, echoes, optics, level)
    corrected = correction.magnitudes(POSES, heard)
    inside = torch.ones(len(POSES), 1, heard.power.shape[2], 1, dtype=torch.bool)
    loudest = corrected[0].amax((1, 2, 3))
    found = (corrected[0], inside, loudest)
    plain = mismatch(*differences(heard, None, found, level, learn=False))
    exact = mismatch(*differences(heard, None, found, level, corrected=corrected, learn=False))
    assert float(exact.detach().max()) < 0.01
    assert float(plain.detach().min()) > 0.1


@pytest.mark.slow
def test_a_simulator_of_another_level_moves_nothing(optics, sphere, simulator, echoes, level):
    """If the measured echoes are the simulator's own, the surface is right as it is."""
    double = Shifted(simulator)
    correction = Correction(optics, sphere, double, echoes, echoes.training, seed=0)
    loud = {
        number: double.spectrogram(echoes.positions[number], echoes.rotations[number], seed=0)
        for number in echoes.training.tolist()
    }
    same = changed(echoes, read=loud.__getitem__)
    work = Descent(
        sphere,
        same,
        optics,
        level,
        smoothing=optics.wavelength,
        rate=0.02,
        correction=correction,
        seed=0,
    )
    assert work.step(0, 0.0) < 0.05
    assert float((work.vertices.norm(dim=1) - RADIUS).abs().mean()) < 1e-4


def test_poses_come_from_those_that_were_chosen(optics, sphere, simulator, echoes):
    chosen = np.array([2, 5, 9])
    correction = Correction(optics, sphere, simulator, echoes, chosen, seed=0)
    drawn = [set(correction.batch(4, step, 2).tolist()) for step in range(20)]
    assert all(len(some) == 2 and some <= {2, 5, 9} for some in drawn)
    assert len({frozenset(some) for some in drawn}) == 3
    assert drawn == [set(correction.batch(4, step, 2).tolist()) for step in range(20)]


def test_what_was_measured_lies_on_the_same_rows(correction, sphere, echoes, optics, level):
    heard = heard_of(sphere, echoes, optics, level)
    magnitude, _, _ = measured(echoes, POSES, heard)
    simulated, _ = correction.magnitudes(POSES, heard)
    loud = magnitude > 0.3 * magnitude.amax()
    assert (20 * torch.log10(simulated[loud] / magnitude[loud])).abs().median() < 1.0
