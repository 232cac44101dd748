# SPDX-License-Identifier: MIT

import numpy as np
import pytest

from sononerf.head.ears import NOTCH_WIDTH
from sononerf.head.front_end import echo_samples
from sononerf.settings.schema import SpectrogramSettings
from sononerf.simulation.impulse_response import air_loss, deposit, plan_synthesis, synthesise

SETTINGS = SpectrogramSettings(range_max=0.3)


@pytest.fixture(scope="module")
def synthesis():
    return plan_synthesis(SETTINGS, echo_samples(SETTINGS, 343.0))


def echo_of(synthesis, delay, strength, spread=0.0, decay=0.0, basis=None):
    """Echo of one or more deposits; delay and spread in samples."""
    delay, spread = np.broadcast_arrays(np.atleast_1d(delay) * 1e-6, np.asarray(spread) * 1e-6)
    shape = (len(delay), len(synthesis.nodes))
    bins = synthesis.silence(np.float64)
    deposit(synthesis, bins, delay, spread, np.broadcast_to(strength, shape))
    decay = np.broadcast_to(decay, shape[1])
    air = air_loss(synthesis, decay)
    return synthesise(synthesis, bins, air, synthesis.basis if basis is None else basis)


def spectrum(echo, frequency, delay=0.0):
    """With time counted from ``delay``, samples."""
    time = (np.arange(len(echo)) - delay) * 1e-6
    return np.exp(-2j * np.pi * np.asarray(frequency)[:, None] * time) @ echo


def test_nodes_are_odd_multiples_of_half_their_spacing(synthesis):
    """So even functions of frequency are sampled evenly across zero, without a node there."""
    spacing = np.diff(synthesis.nodes)
    np.testing.assert_allclose(spacing, spacing[0])
    assert synthesis.nodes[0] == pytest.approx(spacing[0] / 2)
    assert spacing[0] < NOTCH_WIDTH
    assert synthesis.nodes[-1] + spacing[0] / 2 == pytest.approx(150e3)
    low = plan_synthesis(SpectrogramSettings(sampling_rate=200e3, hop=1, window=16), 1000)
    assert low.nodes[-1] + low.nodes[0] == pytest.approx(90e3)


@pytest.mark.parametrize("sample", [700.0, 700.125, 700.5])
def test_spectrum_is_jf_times_the_strength_and_the_delay_exact(synthesis, sample):
    frequency = np.array([10e3, 50e3, 100e3, 150e3])
    found = spectrum(echo_of(synthesis, sample, 2.0), frequency)
    expected = 2.0 * 1j * frequency * np.exp(-2j * np.pi * frequency * sample * 1e-6)
    # Between two fine bins the level errs by up to 0.7 % at 150 kHz, corrected on average.
    np.testing.assert_allclose(found, expected, rtol=0.008)


def notch(frequency, middle):
    return 1.0 - 0.8 * np.exp(-0.5 * np.square((frequency - middle) / NOTCH_WIDTH))


@pytest.mark.parametrize("middle", [45e3, 60e3, 71.3e3])
def test_a_notch_is_heardbetween_the_nodes_as_it_is(synthesis, middle):
    frequency = np.linspace(10e3, 140e3, 131)
    echo = echo_of(synthesis, 700.0, notch(synthesis.nodes, middle), basis=synthesis.hats)
    found = spectrum(echo, frequency, 700.0)
    np.testing.assert_allclose(found, notch(frequency, middle), atol=6e-3)


@pytest.mark.parametrize("middle", [45e3, 60e3, 71.3e3])
def test_nothing_rings_before_an_echo_or_behind_it(synthesis, middle):
    """Straight lines between the nodes repeat an echo at one over their spacing, at -28 dB."""
    echo = echo_of(synthesis, 700.0, notch(synthesis.nodes, middle))
    far = np.abs(np.arange(len(echo)) - 700) > 100
    assert np.abs(echo[far]).max() < 2e-4 * np.abs(echo).max()


@pytest.mark.parametrize("spread", [0.02, 0.11, 0.3, 1.0, 2.5, 7.0, 30.0])
@pytest.mark.parametrize("sample", [700.0, 701.37])
def test_mean_delay_is_exact_at_any_spread(synthesis, sample, spread):
    """Group delay at the lowest frequencies is the mean of the arrival times."""
    # So low that all phases are small; strengths below the lowest node are those of it.
    frequency = np.array([50.0, 100.0])
    echo = echo_of(synthesis, sample, 1.0, spread, basis=synthesis.hats)
    delay = -np.angle(spectrum(echo, frequency, sample)) / (2 * np.pi * frequency)
    np.testing.assert_allclose(delay * 1e6, 0.0, atol=1e-3)


@pytest.mark.parametrize("spread", [0.1, 0.3, 0.5, 1.0, 1.4, 3.0, 8.0, 20.0])
def test_a_spread_echo_fades_like_a_gaussian_of_its_width(synthesis, spread):
    """By (2 pi f s)^2 / 2 at low frequencies, on average over where echoes fall between bins."""
    frequency = 0.1 / (2 * np.pi * spread * 1e-6)
    places = 700.0 + 128.0 * np.arange(89) / 89  # evenly over the bins of every level
    lost = []
    for place in places:
        pair = [
            echo_of(synthesis, place, 1.0, width, basis=synthesis.hats) for width in (spread, 0.0)
        ]
        wide, sharp = (np.abs(spectrum(echo, [frequency], place))[0] for echo in pair)
        lost.append(1.0 - wide / sharp)
    # One echo keeps half to five quarters of its variance, by its place.
    assert np.mean(lost) == pytest.approx(0.1**2 / 2, rel=0.05)
    assert np.max(lost) < 1.4 * 0.1**2 / 2


def test_air_takes_what_it_takes_in_the_time(synthesis):
    """Each node by its own decay; the spread does not matter."""
    decay = np.linspace(100.0, 800.0, len(synthesis.nodes))
    frequency = synthesis.nodes[[1, 5, 9]]
    for spread in (0.0, 2.0):
        kept = [
            np.abs(spectrum(echo_of(synthesis, 900.0, 1.0, spread, loss), frequency))
            for loss in (decay, 0.0)
        ]
        expected = np.exp(-decay[[1, 5, 9]] * 900e-6)
        # A wide bin's decay is taken at its middle.
        np.testing.assert_allclose(kept[0] / kept[1], expected, rtol=1e-3)


def test_a_flat_echo_is_short(synthesis):
    echo = echo_of(synthesis, 700.0, 1.0)
    far = np.abs(np.arange(len(echo)) - 700) > 60
    # 60 samples are one analysis window; beyond, nothing above -60 dB may smear over ranges.
    assert np.abs(echo[far]).max() < 1e-3 * np.abs(echo).max()


@pytest.mark.parametrize("spread", [0.0, 1.0])
def test_late_echoes_are_left_out_and_do_not_wrap(synthesis, spread):
    assert np.abs(echo_of(synthesis, synthesis.samples + 300, 1.0, spread)).max() == 0.0
    last = echo_of(synthesis, synthesis.samples + 200, 1.0, spread)
    assert last.any()
    loud = np.abs(echo_of(synthesis, 700.0, 1.0, spread)).max()
    assert np.abs(last[:500]).max() < 1e-3 * loud


def test_echoes_add_into_what_is_there(synthesis):
    bins = synthesis.silence(np.float64)
    ones = np.ones((1, len(synthesis.nodes)))
    for delay in (500e-6, 500e-6, 901.3e-6):
        deposit(synthesis, bins, np.array([delay]), np.array([4e-7]), ones)
    together = synthesise(synthesis, bins, np.ones_like(bins.values), synthesis.basis)
    apart = 2 * echo_of(synthesis, 500.0, 1.0, 0.4) + echo_of(synthesis, 901.3, 1.0, 0.4)
    np.testing.assert_allclose(together, apart, atol=1e-5 * np.abs(apart).max())


def test_single_precision_suffices(synthesis):
    echoes = []
    for dtype in (np.float32, np.float64):
        bins = synthesis.silence(dtype)
        strength = 1.0 + np.arange(3.0 * len(synthesis.nodes)).reshape(3, -1)
        deposit(synthesis, bins, np.array([5e-4, 6e-4, 9e-4]), np.array([0, 1e-6, 9e-6]), strength)
        air = air_loss(synthesis, np.full(len(synthesis.nodes), 100.0)).astype(dtype)
        echoes.append(synthesise(synthesis, bins, air, synthesis.basis))
    np.testing.assert_allclose(*echoes, atol=1e-6 * np.abs(echoes[1]).max())


def test_an_odd_strength_is_heard_as_it_is_and_leaves_no_tail(synthesis):
    """As an even function it would jump at zero frequency, and fall as one over time alone."""
    late = 8.0  # us
    frequency = np.linspace(10e3, 140e3, 53)
    strength = np.sin(2.0 * np.pi * late * 1e-6 * synthesis.nodes)
    tails = []
    for hats in (synthesis.odd_hats, synthesis.hats):
        echo = echo_of(synthesis, 700.0, strength, basis=1j * hats)
        tails.append(np.abs(echo[1100:1400]).max() / np.abs(echo).max())
        found = spectrum(echo, frequency, 700.0)
        np.testing.assert_allclose(
            found, 1j * np.sin(2.0 * np.pi * late * 1e-6 * frequency), atol=0.02
        )
    assert tails[0] < 1e-5
    assert tails[1] > 2e-5
