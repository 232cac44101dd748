# SPDX-License-Identifier: MIT
import numpy as np
import pytest

from sononerf.head.call import call_waveform, sweep_delay
from sononerf.head.smearing import smearing
from sononerf.head.spectrogram import echo_samples, frequency_axis, range_axis, spectrogram
from sononerf.settings.schema import CallSettings, SpectrogramSettings

SPEED = 343.0


def notched(frequency):
    """Gain with a notch of 8 kHz at 60 kHz."""
    return 1.0 - 0.8 * np.exp(-0.5 * ((frequency - 60e3) / 8e3) ** 2)


def heard(call, analysis):
    """Rows (2, R, F) of a call as it is and through the notch, their axis of time, s."""
    delay = sweep_delay(call, frequency_axis(analysis))
    echo = np.zeros(echo_samples(analysis, SPEED, float(delay.max())))
    waveform = call_waveform(call, 1e6)
    echo[2000 : 2000 + len(waveform)] = waveform
    gain = notched(np.fft.rfftfreq(len(echo), 1e-6))
    both = np.stack((echo, np.fft.irfft(np.fft.rfft(echo) * gain, len(echo))))
    time = 2 * range_axis(analysis, SPEED) / SPEED - 2000e-6
    return spectrogram(both, analysis, SPEED, delay), time


@pytest.mark.parametrize("q", [2.0, 4.0, 9.0])
def test_a_gammatones_channel_hears_the_mean_about_its_frequency(q):
    analysis = SpectrogramSettings(kind="gammatone", q=q, hop=1)
    found = smearing(CallSettings(), analysis)
    assert found.later is None
    np.testing.assert_allclose(abs(found.weight.sum(axis=1)), 1.0)
    rows, time = heard(CallSettings(), analysis)
    expected = rows[1][np.abs(time).argmin()]
    gain = abs((found.weight * notched(found.frequency[found.rows])).sum(axis=1))
    np.testing.assert_allclose(gain, expected, atol=0.02)
    raw = notched(np.geomspace(10e3, 100e3, 48))
    assert abs(raw - expected).max() > 0.05


def test_a_gammatones_channel_hears_the_power_of_a_sweep():
    analysis = SpectrogramSettings(kind="gammatone", frequency_min=45e3, hop=1)
    call = CallSettings(kind="linear", duration=1e-3, frequency_end=25e3)
    found = smearing(call, analysis)
    np.testing.assert_allclose(found.weight.sum(axis=1), 1.0)
    rows, time = heard(call, analysis)
    power = rows**2
    expected = np.sqrt(power[1].sum(axis=0) / power[0].sum(axis=0))
    heard_power = found.weight * notched(found.frequency[found.rows]) ** 2
    np.testing.assert_allclose(np.sqrt(heard_power.sum(axis=1)), expected, atol=0.02)
    late = (time @ power[1]) / power[1].sum(axis=0) - (time @ power[0]) / power[0].sum(axis=0)
    later = found.later * notched(found.frequency[found.rows]) ** 2
    shift = later.sum(axis=1) / heard_power.sum(axis=1) - found.later.sum(axis=1)
    assert abs(late).max() > 30e-6
    # The filter's own delay, which is less off its middle, is left out.
    np.testing.assert_allclose(shift, late, atol=15e-6)
