# SPDX-License-Identifier: MIT
import numpy as np
import pytest

from sononerf.config import SpectrogramSettings
from sononerf.simulation.impulse_response import deposit, plan_synthesis, synthesise

SETTINGS = SpectrogramSettings(range_max=0.3)


@pytest.fixture(scope="module")
def synthesis():
    return plan_synthesis(SETTINGS, 343.0)


def echo_of(synthesis, delay, strength):
    strength = np.broadcast_to(strength, (1, len(synthesis.nodes)))
    return synthesise(synthesis, deposit(synthesis, np.array([delay]), strength))


def test_nodes_cover_the_band(synthesis):
    assert len(synthesis.nodes) == 14
    np.testing.assert_allclose(synthesis.nodes[[0, -1]], [5e3, 150e3])
    low = plan_synthesis(SpectrogramSettings(sampling_rate=200e3, hop=1, window=16), 343.0)
    assert low.nodes[-1] == pytest.approx(90e3)


@pytest.mark.parametrize("sample", [700.0, 700.125, 700.5])
def test_spectrum_is_jf_times_the_strength_and_the_delay_exact(synthesis, sample):
    echo = echo_of(synthesis, sample * 1e-6, 2.0)
    frequency = np.array([10e3, 50e3, 100e3, 150e3])
    phase = np.exp(-2j * np.pi * frequency[:, None] * np.arange(len(echo)) * 1e-6)
    found = phase @ echo
    expected = 2.0 * 1j * frequency * np.exp(-2j * np.pi * frequency * sample * 1e-6)
    # Between two fine bins the level errs by up to 0.7 % at 150 kHz, corrected on average.
    np.testing.assert_allclose(found, expected, rtol=0.008)


def test_strengths_run_straight_between_nodes(synthesis):
    slope = synthesis.nodes / 1e5
    echo = echo_of(synthesis, 700e-6, slope)
    frequency = np.array([20e3, 77e3, 143e3])
    phase = np.exp(-2j * np.pi * frequency[:, None] * (np.arange(len(echo)) - 700) * 1e-6)
    np.testing.assert_allclose((phase @ echo).imag, frequency * frequency / 1e5, rtol=0.01)


def test_a_flat_echo_is_short(synthesis):
    echo = echo_of(synthesis, 700e-6, 1.0)
    far = np.abs(np.arange(len(echo)) - 700) > 60
    # 60 samples are one analysis window; beyond, nothing above -60 dB may smear over ranges.
    assert np.abs(echo[far]).max() < 1e-3 * np.abs(echo).max()


def test_late_echoes_are_left_out_and_do_not_wrap(synthesis):
    assert echo_of(synthesis, (synthesis.samples + 300) * 1e-6, 1.0).max() == 0.0
    last = echo_of(synthesis, (synthesis.samples + 200) * 1e-6, 1.0)
    loud = np.abs(echo_of(synthesis, 700e-6, 1.0)).max()
    assert np.abs(last[:500]).max() < 1e-3 * loud


def test_echoes_add(synthesis):
    count = len(synthesis.nodes)
    delays = np.array([500e-6, 500e-6, 901.3e-6])
    together = synthesise(synthesis, deposit(synthesis, delays, np.ones((3, count))))
    apart = sum(echo_of(synthesis, delay, 1.0) for delay in delays)
    np.testing.assert_allclose(together, apart, atol=1e-6)
