# SPDX-License-Identifier: MIT
"""Levels over range, and their statistics at places."""

from __future__ import annotations

import numpy as np
import pytest

from sononerf.echoes import range_levels
from sononerf.echoes.range_levels import STATISTICS, RangeLevels

RESOLUTION, SPACING, FIRST = 0.006, 0.001, 0.2
EARS = np.array([[0.0, 0.01, 0.0], [0.0, -0.01, 0.0]])
MEAN, BELOW, PEAKS, LOUDEST = 0, 1, 2, 6
DIRECTION = slice(7, 10)


def around(count):
    way = np.random.default_rng(3).normal(size=(count, 3))
    return 0.4 * way / np.linalg.norm(way, axis=1, keepdims=True)


def heard(emitters, points, amplitudes, scale=1.0):
    """Levels of points; each sends all poses its amplitude (P,), spread over both ways."""
    receivers = emitters[:, None] + scale * EARS
    ranges = scale * (FIRST + SPACING * np.arange(400))
    spectrograms = np.full((len(emitters), len(EARS), len(ranges), 3), 1e-9)
    for point, amplitude in zip(points, amplitudes, strict=True):
        out = np.linalg.norm(emitters - point, axis=1)[:, None]
        back = np.linalg.norm(receivers - point, axis=2)
        off = (ranges - ((out + back) / 2)[..., None]) / (0.3 * scale * RESOLUTION)
        pulse = np.exp(-(off**2)) * (np.reshape(amplitude, (-1, 1)) / (out * back))[..., None]
        spectrograms += pulse[..., None]
    return RangeLevels.of(
        spectrograms,
        emitters,
        receivers,
        first=scale * FIRST,
        spacing=scale * SPACING,
        resolution=scale * RESOLUTION,
    )


def test_a_point_that_all_poses_hear_is_a_peak_of_all():
    point = np.array([0.01, 0.02, -0.01])
    levels = heard(around(60), [point], [1.0])
    at, beside = levels.statistics(point + np.diag([0.0, 0.0, 0.03])[1:], point)
    assert at[PEAKS] == 1.0
    assert at[BELOW] > 0.9
    assert at[MEAN] == pytest.approx(1.0, abs=0.1)  # 0 dB, that of the loudest
    assert beside[PEAKS] < 0.3
    assert beside[MEAN] < at[MEAN] - 0.5


def test_the_direction_is_that_of_the_poses_that_hear_it():
    emitters = around(200)
    ahead = emitters[:, 0] > 0.35
    levels = heard(emitters, [np.zeros(3)], [np.where(ahead, 1.0, 1e-3)])
    found = levels.statistics(np.zeros((1, 3)), np.zeros(3))[0, DIRECTION]
    assert found[0] > 1.5  # twice a unit vector, but for the poses beside
    assert abs(found[1:]).max() < 0.3


def test_lengths_count_in_range_resolutions():
    places = 0.02 * np.random.default_rng(0).normal(size=(50, 3))
    points, scale = [np.zeros(3), np.array([0.0, 0.015, 0.0])], 3.0
    emitters = around(40)
    small = heard(emitters, points, [1.0, 0.5]).statistics(places, np.zeros(3))
    large = heard(scale * emitters, points_of(points, scale), [1.0, 0.5], scale)
    off = np.abs(large.statistics(scale * places, np.zeros(3)) - small)
    assert np.quantile(off, 0.99) < 0.1


def points_of(points, scale):
    return [scale * point for point in points]


def test_a_place_out_of_range_and_silent_echoes_have_no_statistics():
    levels = heard(around(10), [np.zeros(3)], [1.0])
    np.testing.assert_array_equal(
        levels.statistics(np.full((1, 3), 2.0), np.zeros(3)), np.zeros((1, STATISTICS))
    )
    receivers = around(4)[:, None] + EARS
    silent = RangeLevels.of(
        np.zeros((4, 2, 400, 3)),
        around(4),
        receivers,
        first=FIRST,
        spacing=SPACING,
        resolution=RESOLUTION,
    )
    assert np.isfinite(silent.statistics(np.zeros((1, 3)), np.zeros(3))).all()


def test_of_many_poses_some_are_used(monkeypatch):
    places = 0.01 * np.random.default_rng(0).normal(size=(20, 3))
    levels = heard(around(400), [np.zeros(3)], [1.0])
    whole = levels.statistics(places, np.zeros(3))
    monkeypatch.setattr(range_levels, "MOST", 100)
    some = levels.statistics(places, np.zeros(3))
    assert np.abs(some - whole)[:, : DIRECTION.start].mean() < 0.1
    assert (some != whole).any()
