# SPDX-License-Identifier: MIT
from __future__ import annotations

import numpy as np
import torch
import trimesh

from sononerf.surface.refine.optics import Heard
from sononerf.surface.refine.tracer import Tracer
from tests.surface.conftest import RADIUS


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


def test_later_bounces_are_as_loud_as_the_simulator_makes_them(optics, ball):
    other = ball.copy()
    other.apply_translation([0.0, 2.5 * RADIUS, 0.0])
    pair = trimesh.util.concatenate([ball, other])
    tracer = Tracer(optics, pair, rays=20_000, seed=0)
    at, turn = np.array([0.3, 0.0, 0.0]), np.diag([-1.0, -1.0, 1.0])
    engine = tracer._simulator.rays
    sound = engine.hearing.silence()
    engine.later(sound, at, turn, seed=0)
    echo = engine.hearing.echo(sound, engine._basis)
    wanted = optics.head.receive(echo, seed=0)[1]
    later = tracer.later(at, turn)
    like = Heard(torch.zeros(1, 2, 512, len(optics.frequencies)), torch.tensor([0]))
    power = optics.later_power(
        torch.zeros(len(later.ear), dtype=torch.int64),
        torch.as_tensor(later.ear),
        torch.as_tensor(later.delay),
        torch.as_tensor(later.weight),
        like,
    )
    found = power[0].sqrt().numpy()[:, : wanted.shape[1]]
    wanted = wanted[:, : found.shape[1]]
    loud = wanted > 0.3 * wanted.max()
    assert np.abs(20 * np.log10(found[loud] / wanted[loud])).mean() < 0.3


def test_a_tracer_hears_what_the_simulator_hears(optics, echoes, ball):
    fine = trimesh.creation.icosphere(subdivisions=5, radius=RADIUS)
    tracer = Tracer(optics, fine, rays=20_000, seed=0)
    (found,) = tracer.spectrograms(echoes.positions[:1], echoes.rotations[:1])
    wanted = echoes.magnitude(0).numpy()
    assert np.allclose(found, wanted, atol=0.02 * wanted.max())
