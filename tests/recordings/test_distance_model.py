# SPDX-License-Identifier: MIT
"""First echoes predict one another: each is left out of the fit that predicts it."""

from __future__ import annotations

import numpy as np

from sononerf.recordings.distance_model import predict
from tests.recordings.bodies import EARS, EMITTER, body, first_echoes, poses_of


def predicted(poses, first):
    out = poses.positions + poses.rotations @ EMITTER
    back = poses.positions[:, None] + np.einsum("pij,ej->pei", poses.rotations, EARS)
    first = np.where(np.isfinite(first), first, np.nan)
    return predict((out[:, None] + back) / 2, back - out[:, None], first)


def test_a_sphere_is_found_with_centre_and_size():
    rng = np.random.default_rng(0)
    unit = rng.normal(size=(20_000, 3))
    ball = [0.02, -0.01, 0.03] + 0.04 * unit / np.linalg.norm(unit, axis=1, keepdims=True)
    poses = poses_of(rng, "volume")
    found = predicted(poses, first_echoes(rng, poses, ball))
    np.testing.assert_allclose(found.centre, [0.02, -0.01, 0.03], atol=1e-3)
    assert abs(found.size - 0.04) < 1e-3
    assert np.nanmedian(np.abs(found.residual)) < 1e-3


def test_bodies_of_parts_are_predicted_to_millimetres():
    for seed in range(4):
        rng = np.random.default_rng(seed)
        poses = poses_of(rng, ("sphere", "table")[seed % 2])
        first = first_echoes(rng, poses, body(rng))
        found = predicted(poses, first)
        assert np.nanmedian(np.abs(found.residual)) < 4e-3
        assert np.isnan(found.residual[~np.isfinite(first)]).all()
        assert np.isfinite(found.residual[np.isfinite(first)]).all()


def test_late_echoes_leave_no_body():
    rng = np.random.default_rng(1)
    poses = poses_of(rng, "sphere")
    found = predicted(poses, first_echoes(rng, poses, body(rng)) + 0.15)
    assert found.size < -0.05


def test_few_pings_leave_a_sphere():
    rng = np.random.default_rng(2)
    poses = poses_of(rng, "sphere")[np.arange(0, 90, 6)]
    found = predicted(poses, first_echoes(rng, poses, body(rng)))
    assert np.nanmedian(np.abs(found.residual)) < 0.02
