# SPDX-License-Identifier: MIT
from __future__ import annotations

import numpy as np
import trimesh

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


def test_a_tracer_hears_what_the_simulator_hears(optics, echoes, ball):
    fine = trimesh.creation.icosphere(subdivisions=5, radius=RADIUS)
    tracer = Tracer(optics, fine, rays=20_000, seed=0)
    (found,) = tracer.spectrograms(echoes.positions[:1], echoes.rotations[:1])
    wanted = echoes.magnitude(0).numpy()
    assert np.allclose(found, wanted, atol=0.02 * wanted.max())
