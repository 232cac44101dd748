# SPDX-License-Identifier: MIT
"""First echoes and region of a body that is heard by calls of bats."""

from __future__ import annotations

import numpy as np
import pytest
import trimesh

import sononerf as sn
from sononerf.echoes.detection import find_onsets
from sononerf.settings.sections import CALL_PRESETS

RADIUS, PLACE = 0.02, np.array([0.03, 0.01, -0.02])


@pytest.mark.parametrize("preset", [*CALL_PRESETS])
def test_first_echoes_and_region_are_those_of_the_body(preset):
    ball = trimesh.creation.icosphere(4, RADIUS).apply_translation(PLACE)
    poses, head = sn.Poses.sphere(40, radius=0.4), sn.Head(call={"preset": preset})
    heard = sn.simulate(sn.Scene(ball), poses, head, split=["train"] * 40)
    onsets = find_onsets(heard.store, head.point_echo)
    emitters, receivers = head.places(poses.positions, poses.rotations)
    out = np.linalg.norm(emitters - PLACE, axis=1)[:, None]
    true = (out + np.linalg.norm(receivers - PLACE, axis=2)) / 2.0 - RADIUS
    assert np.abs(onsets.first - true[onsets.poses]).max() < 0.25 * head.resolution
    box = heard.region.box()
    assert (box[0] < ball.bounds[0]).all()
    assert (box[1] > ball.bounds[1]).all()
    size = np.diff(box, axis=0)[0]
    assert (size < 2.0 * 2.0 * RADIUS + 2.0 * head.resolution).all()
