# SPDX-License-Identifier: MIT
"""Poses that look away from a body are told, with the mistake that explains it."""

from __future__ import annotations

import numpy as np
import pytest

from sononerf.geometry.poses import (
    Poses,
    aim_fault,
    euler_from_rotation,
    off_axis,
    rotation_from_euler,
)

CENTRE = np.array([0.03, -0.02, 0.01])
RIGHT = Poses.looking_at(
    Poses.sphere(60, radius=0.4, generator=np.random.default_rng(1)).positions, CENTRE
)
YAW, PITCH, ROLL = euler_from_rotation(RIGHT.rotations)


def read_as(*angles):
    return Poses(RIGHT.positions, rotation_from_euler(*angles))


def test_heads_that_look_at_the_body_or_a_little_past_it_raise_no_question():
    np.testing.assert_allclose(off_axis(RIGHT, CENTRE), 0.0, atol=1e-6)
    assert aim_fault(RIGHT, CENTRE) == ""
    jittered = Poses.sphere(60, radius=0.4, aim_jitter=np.radians(25))
    assert aim_fault(jittered, CENTRE) == ""


@pytest.mark.parametrize(
    ("angles", "cause"),
    [
        ((np.radians(YAW), np.radians(PITCH), np.radians(ROLL)), "radians, and are read as deg"),
        ((PITCH, YAW, ROLL), "yaw and pitch are swapped"),
        ((YAW + np.pi, -PITCH, -ROLL), "the poses look the other way"),
        ((-YAW, PITCH, ROLL), "the sign of yaw is the opposite one"),
    ],
)
def test_the_mistake_is_named(angles, cause):
    fault = aim_fault(read_as(*angles), CENTRE)
    assert fault.startswith(("poses look away from the body", "poses look past the body"))
    assert cause in fault


def test_the_sign_of_pitch_is_named_where_poses_are_high():
    high = Poses.looking_at(RIGHT.positions[RIGHT.positions[:, 2] > 0.2], CENTRE)
    yaw, pitch, roll = euler_from_rotation(high.rotations)
    fault = aim_fault(Poses(high.positions, rotation_from_euler(yaw, -pitch, roll)), CENTRE)
    assert "sign of pitch is the opposite one" in fault


def test_poses_that_look_anywhere_are_told_without_a_cause():
    turns = np.random.default_rng(0).uniform(-3, 3, (3, 60))
    fault = aim_fault(read_as(*turns), CENTRE)
    assert "by " in fault
    assert "perhaps" not in fault
