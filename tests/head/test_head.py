# SPDX-License-Identifier: MIT
"""One head answers for places, air and lag."""

import numpy as np
import pytest

from sononerf.geometry.poses import rotation_from_euler
from sononerf.head.head import Head, PointEcho, own_top
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


def test_the_echo_of_a_point_has_the_spacing_of_samples_and_half_its_power_in_a_resolution():
    head = Head(air={"speed_of_sound": 340.0})
    assert head.point_echo.spacing == pytest.approx(170.0 / head.analysis.sampling_rate)
    triangle = np.concatenate((np.arange(0.0, 8.0), np.arange(8.0, -1.0, -1.0))) / 8.0
    echo = PointEcho(window=triangle**2, rows=None, spacing=0.002, looks=1.0)
    assert echo.resolution == pytest.approx(0.018)  # nine of its magnitudes are one half or more


def test_the_top_of_a_window_may_be_its_end():
    rising = np.arange(7.0)
    assert (own_top(rising), own_top(rising[::-1])) == (6, 0)
    assert own_top(np.array([9.0, 0.0, 1.0, 2.0, 3.0, 1.0, 0.0])) == 4


def test_the_shortest_wavelength_is_that_of_the_highest_row():
    head = Head(air={"speed_of_sound": 340.0}, analysis={"frequency_max": 80e3})
    assert head.wavelength == pytest.approx(340.0 / head.frequency.max())


def test_a_head_has_a_plane_where_things_stand_on_a_support():
    assert Head().plane is None
    plane = Head(support={"point": [0.0, 0.0, -0.1]}).plane
    assert plane is not None
    assert plane.height(np.array([[0.0, 0.0, 0.3]])) == pytest.approx(0.4)
