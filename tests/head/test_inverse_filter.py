# SPDX-License-Identifier: MIT
"""Echoes of a sweep become those of an impulse, within the sweep's band."""

from __future__ import annotations

import numpy as np
import pytest

from sononerf.head.call import call_waveform, inverse_filter
from sononerf.settings.schema import CallSettings

RATE = 500e3
CALL = call_waveform(
    CallSettings(kind="linear", duration=1e-3, frequency_start=90e3, frequency_end=30e3), RATE
)


def echo(at, gain, samples=2000):
    heard = np.zeros(samples)
    heard[at : at + len(CALL)] += gain * CALL
    return heard


def test_an_echo_becomes_an_impulse_of_its_strength():
    found = inverse_filter(np.stack([echo(700, 0.5), echo(300, -2.0)]), CALL)
    assert np.abs(found).argmax(axis=1).tolist() == [700, 300]
    spectrum = np.abs(np.fft.rfft(found[0], 4000))
    frequency = np.fft.rfftfreq(4000, 1 / RATE)
    inside = (frequency > 35e3) & (frequency < 85e3)
    np.testing.assert_allclose(spectrum[inside], 0.5, rtol=0.05)
    assert spectrum[frequency < 10e3].max() < 0.05


def test_two_echoes_that_overlap_are_told_apart():
    found = np.abs(inverse_filter(echo(700, 1.0) + echo(720, 1.0), CALL))
    assert set(np.argsort(found)[-2:]) == {700, 720}
    assert found[710] < 0.5 * found[700]


def test_noise_does_not_grow_outside_the_band():
    noise = np.random.default_rng(0).standard_normal(4000)
    found = np.abs(np.fft.rfft(inverse_filter(noise, CALL)))
    frequency = np.fft.rfftfreq(4000, 1 / RATE)
    assert found[frequency > 150e3].max() < found[(frequency > 40e3) & (frequency < 80e3)].mean()


def test_a_silent_call_is_refused():
    with pytest.raises(ValueError, match="not silent"):
        inverse_filter(np.ones(10), np.zeros(4))
