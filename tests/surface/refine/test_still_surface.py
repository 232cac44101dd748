# SPDX-License-Identifier: MIT
from __future__ import annotations

import numpy as np
import pytest

from sononerf.surface.refine.visibility import StillSurface


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
