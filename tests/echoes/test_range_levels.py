# SPDX-License-Identifier: MIT
"""Levels of the echoes over range."""

from __future__ import annotations

import numpy as np
import pytest

from sononerf.echoes.detection import FEWEST_POSES, MOST_PAIRS, RangeLevels, evenly_chosen
from sononerf.geometry.meshes import Plane

RESOLUTION, SPACING, FIRST = 0.006, 0.0007, 0.2


def levels_of(spectrograms, resolution=RESOLUTION):
    count, ears = spectrograms.shape[:2]
    emitters = np.random.default_rng(0).normal(size=(count, 3))
    receivers = emitters[:, None] + 0.01 * np.arange(ears)[:, None]
    return RangeLevels.of(
        spectrograms,
        np.arange(count),
        emitters,
        receivers,
        first=FIRST,
        spacing=SPACING,
        resolution=resolution,
    )


def test_levels_are_the_power_of_bands_and_of_all_frequencies():
    spectrograms = np.full((2, 2, 40, 6), 1e-9)
    spectrograms[:, :, 10:12, :2] = 2.0  # the lowest third
    spectrograms[0, :, 20:22] = 2.0
    low, high, whole = np.moveaxis(levels_of(spectrograms).level, 3, 0)
    assert low[0, 0, 10] == pytest.approx(0.0, abs=1e-4)  # the loudest of all
    np.testing.assert_allclose(low[:, 0, 5], 0.0, atol=1e-4)
    assert (high[:, 0, 5] == -60.0).all()
    np.testing.assert_allclose(whole[:, 0, 5], 10 * np.log10(1 / 3), atol=1e-3)
    assert (whole[:, 0, 0] == -60.0).all()


def test_slices_are_averaged_to_about_four_in_a_resolution():
    spectrograms = np.random.default_rng(1).exponential(size=(1, 1, 41, 3))
    levels = levels_of(spectrograms)
    assert levels.level.shape == (1, 1, 20, 3)
    assert levels.spacing == pytest.approx(2 * SPACING)
    assert levels.first == pytest.approx(FIRST + SPACING / 2)
    assert levels_of(spectrograms, 4 * SPACING).spacing == pytest.approx(SPACING)


def test_silent_echoes_are_silent_everywhere():
    assert (levels_of(np.zeros((2, 1, 10, 3))).level == -60.0).all()


@pytest.mark.parametrize(("count", "ears", "used"), [(400, 2, 400), (2000, 2, 640), (99, 64, 40)])
def test_of_many_pairs_some_poses_are_used(count, ears, used):
    some = evenly_chosen(count, ears)
    assert len(np.unique(some)) == used
    assert used == min(count, max(FEWEST_POSES, MOST_PAIRS // ears))
    assert some.max() < count


def test_images_follow_the_poses():
    table = Plane((0.0, 0.0, -1.0), (0.0, 0.0, 1.0))
    levels = levels_of(np.ones((3, 2, 10, 3)))
    both = levels.with_images(table, 5)
    assert both.poses.tolist() == [0, 1, 2, 5, 6, 7]
    np.testing.assert_allclose(both.emitters[3:, 2], -2.0 - levels.emitters[:, 2])
    np.testing.assert_array_equal(both.level[3:], levels.level)
