# SPDX-License-Identifier: MIT
"""A surface is laid over its truth, wherever it lies and however large it is."""

from __future__ import annotations

import numpy as np
import pytest
import trimesh

from sononerf.evaluation.geometry import register


@pytest.fixture(scope="module")
def body():
    """Three boxes without any symmetry."""
    parts = [trimesh.creation.box(size) for size in ((0.1, 0.06, 0.04), (0.03,) * 3, (0.01,) * 3)]
    parts[1].apply_translation((0.05, 0.02, 0.03))
    parts[2].apply_translation((-0.04, 0.03, 0.02))
    return trimesh.util.concatenate(parts)


def moved(mesh, scale, seed):
    turn = trimesh.transformations.random_rotation_matrix(np.random.default_rng(seed).random(3))
    other = mesh.copy()
    other.apply_transform(turn)
    other.apply_scale(scale)
    other.apply_translation((0.2, -0.5, 0.1))
    return other


@pytest.mark.parametrize("seed", [0, *(pytest.param(n, marks=pytest.mark.slow) for n in (1, 2, 3))])
@pytest.mark.parametrize(("kind", "scale"), [("rigid", 1.0), ("similarity", 2.5)])
def test_a_moved_body_comes_back(body, kind, scale, seed):
    found = register(moved(body, 1.0 / scale, seed), body, kind)
    assert found.scale == pytest.approx(scale, rel=0.01)
    again = found.of(moved(body, 1.0 / scale, seed))
    assert np.abs(again.vertices - body.vertices).max() < 0.001
    back = found.inverse().of(again)
    assert np.allclose(back.vertices, moved(body, 1.0 / scale, seed).vertices)


def test_no_registration_moves_nothing_and_a_rigid_one_keeps_the_size(body):
    assert np.array_equal(register(moved(body, 2.0, 0), body, "none").matrix, np.eye(4))
    assert register(moved(body, 2.0, 0), body, "rigid").scale == pytest.approx(1.0)


def test_a_mirror_image_stays_one(body):
    mirrored = body.copy()
    mirrored.apply_transform(np.diag([-1.0, 1.0, 1.0, 1.0]))
    motion = register(mirrored, body, "similarity")
    assert np.linalg.det(motion.matrix[:3, :3]) > 0
    assert np.abs(motion.of(mirrored).vertices - body.vertices).max() > 0.005
