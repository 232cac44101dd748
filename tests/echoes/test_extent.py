# SPDX-License-Identifier: MIT
"""Range limits hold the echoes, whatever noise and single outliers do."""

from __future__ import annotations

import numpy as np

from sononerf.echoes.region import echo_extent

AXIS = 0.2 + 0.001 * np.arange(600)
LOOKS = 4.0


def power_of(centres, level=1e4):
    """Echoes 20 mm wide in gamma-distributed noise, (P, 1, R)."""
    noise = np.random.default_rng(0).gamma(LOOKS, 1 / LOOKS, (len(centres), 1, len(AXIS)))
    shape = np.exp(-(((AXIS - np.asarray(centres)[:, None]) / 0.004) ** 2))
    return noise + level * shape[:, None]


def test_limits_lie_around_the_echoes():
    low, high = echo_extent(power_of(np.linspace(0.4, 0.55, 80)), AXIS, LOOKS, 0.01)
    assert 0.365 < low < 0.395
    assert 0.555 < high < 0.585


def test_one_ping_of_many_does_not_widen_them():
    centres = np.full(120, 0.5)
    centres[7] = 0.75
    low, high = echo_extent(power_of(centres), AXIS, LOOKS, 0.01)
    assert 0.46 < low < 0.5 < high < 0.54


def test_silence_leaves_the_axis_whole():
    limits = echo_extent(power_of(np.full(10, 0.5), level=0.0), AXIS, LOOKS, 0.01)
    assert limits == (AXIS[0], AXIS[-1])
