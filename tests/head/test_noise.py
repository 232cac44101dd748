# SPDX-License-Identifier: MIT
import numpy as np
import pytest

from sononerf.head.reception import draw_noise, loudest_power, noise_level, target_gain
from sononerf.settings.schema import NoiseSettings, SpectrogramSettings

ANALYSIS = SpectrogramSettings()


def tone(frequency, first, last, amplitude):
    time = np.arange(6000)
    inside = (time >= first) & (time < last)
    return amplitude * inside * np.sin(2 * np.pi * frequency * time / 1e6)


def test_a_targets_echo_on_paper():
    assert target_gain(-40.0, 1.0) == pytest.approx(0.01)
    assert target_gain(-40.0, 2.0) == pytest.approx(0.0025)  # half the pressure each way


def test_loudest_power_is_that_of_the_loudest_tone_within_the_band():
    quiet_then_loud = tone(50e3, 500, 2500, 1.0) + tone(50e3, 3000, 5000, 3.0)
    outside = quiet_then_loud + tone(200e3, 0, 6000, 50.0)
    found = loudest_power(np.stack([quiet_then_loud, outside]), ANALYSIS, 1000)
    np.testing.assert_allclose(found, 9.0 / 2, rtol=0.02)


def test_a_stretch_at_either_end_counts_and_does_not_wrap():
    both_ends = tone(50e3, 0, 500, 1.0) + tone(50e3, 5500, 6000, 1.0)
    found = loudest_power(both_ends[None], ANALYSIS, 1000)
    np.testing.assert_allclose(found, 0.5 / 2, rtol=0.03)


@pytest.mark.parametrize(("snr_db", "ratios"), [(20.0, (20.0, 20.0)), ((30.0, -3.0), (30.0, -3.0))])
def test_ratio_of_powers_within_the_band_is_as_stated(snr_db, ratios):
    echo = np.stack([tone(60e3, 1000, 4000, 2.0), tone(30e3, 1000, 4000, 0.5)])
    power = loudest_power(echo, ANALYSIS, 3000)
    level = noise_level(NoiseSettings(snr_db=snr_db), power, ANALYSIS)
    noise = draw_noise(level, 400_000, seed=3)
    spectrum = np.abs(np.fft.rfft(noise)) ** 2
    frequency = np.fft.rfftfreq(400_000, 1e-6)
    band = (frequency >= 10e3) & (frequency <= 100e3)
    heard = 2 * spectrum[:, band].sum(axis=1) / 400_000**2  # Parseval
    np.testing.assert_allclose(10 * np.log10([2.0, 0.125] / heard), ratios, atol=0.15)


def test_noise_is_a_function_of_the_seed_and_of_nothing_else_drawn_from_it():
    level = np.ones(2)
    one = draw_noise(level, 5000, seed=7)
    np.testing.assert_array_equal(one, draw_noise(level, 5000, seed=7))
    others = [
        draw_noise(level, 5000, seed=8)[0],
        np.random.default_rng(7).standard_normal((2, 5000))[0],
        one[1],
    ]
    for other in others:
        assert abs(np.corrcoef(one[0], other)[0, 1]) < 0.06
