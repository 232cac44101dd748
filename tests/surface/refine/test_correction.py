# SPDX-License-Identifier: MIT
"""The simulator corrects what physical optics lacks, on a surface that is almost right."""

from __future__ import annotations

import numpy as np
import pytest
import torch

from sononerf.run.build import simulator_of
from sononerf.scene.scene import Scene
from sononerf.surface.refine.descent import Descent
from sononerf.surface.refine.objective import Level, differences, measured, mismatch
from sononerf.surface.refine.remesh import remesh
from sononerf.surface.refine.tracer import Correction
from tests.memory import changed
from tests.surface.conftest import RADIUS

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
    found = Level(optics.ears, len(optics.frequencies), optics.get_buffer("wavenumber"))
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
