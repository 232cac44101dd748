# SPDX-License-Identifier: MIT
"""One head answers for places, air and lag."""

import numpy as np
import pytest

from sononerf.geometry.poses import rotation_from_euler
from sononerf.head.head import Head
from sononerf.settings.schema import CallSettings, EarSettings, SpectrogramSettings


def test_places_are_moved_and_turned_with_the_head():
    head = Head(ears=EarSettings(emitter=(0.02, 0.0, 0.0), left=(0.0, 0.01, 0.0)))
    left = rotation_from_euler(np.pi / 2, 0.0, 0.0)  # looks along y
    emitter, receivers = head.places([1.0, 2.0, 3.0], left)
    np.testing.assert_allclose(emitter, [1.0, 2.02, 3.0])
    np.testing.assert_allclose(receivers, [[0.99, 2.0, 3.0], [1.01, 2.0, 3.0]])


def test_the_air_takes_as_many_decibels_as_it_says():
    head = Head()
    left = np.exp(-2.0 * head.row_absorption)  # of the amplitude after 2 m
    np.testing.assert_allclose(20 * np.log10(left), -2.0 * head.absorption(head.frequency))
    assert -20 * np.log10(left[-1]) == pytest.approx(6.5, rel=0.15)  # 100 kHz, 20 degrees, 50 %


def test_the_mean_lag_is_that_of_the_directions_that_are_heard():
    assert Head().mean_lag == 0.0
    head = Head(call=CallSettings(kind="linear", duration=1e-3), analysis=SpectrogramSettings())
    gains = head.row_gains.beam * head.row_gains.ears
    loud = gains > 0.5 * gains.max()
    assert head.lag[loud].min() < head.mean_lag < head.lag[loud].max()
    assert np.ptp(head.lag[loud]) < 0.2 * np.ptp(head.lag)
