# SPDX-License-Identifier: MIT
import numpy as np
import pytest

from sononerf.head.call import call_waveform
from sononerf.head.matched_filter import matched_filter
from sononerf.settings.schema import CallSettings

CALL = call_waveform(CallSettings(kind="linear", duration=1e-3, frequency_start=90e3), 1e6)


def echoes(*delays_and_gains, samples=4000):
    heard = np.zeros(samples)
    for delay, gain in delays_and_gains:
        heard[delay : delay + len(CALL)] += gain * CALL
    return heard


def test_an_echo_is_compressed_at_its_delay_to_its_gain():
    found = matched_filter(np.stack([echoes((700, 0.5)), echoes((1303, -2.0))]), CALL)
    assert found.shape == (2, 4000)
    np.testing.assert_array_equal(abs(found).argmax(axis=1), [700, 1303])
    np.testing.assert_allclose(found[[0, 1], [700, 1303]].real, [0.5, -2.0], rtol=1e-9)
    # A sweep of 1 ms over 50 kHz becomes some 20 µs long.
    assert (abs(found[0]) > 0.25).sum() < 40


def test_two_echoes_that_overlap_in_time_are_told_apart():
    found = abs(matched_filter(echoes((700, 1.0), (760, 1.0)), CALL))
    assert found[[700, 760]].min() > 2 * found[730]


def test_it_is_the_correlation_and_its_quadrature():
    heard = np.random.default_rng(0).normal(size=500)
    call = np.random.default_rng(1).normal(size=40)
    expected = np.correlate(np.pad(heard, (0, 39)), call, mode="valid") / (call**2).sum()
    found = matched_filter(heard, call)
    np.testing.assert_allclose(found.real, expected, atol=1e-12)
    tone = np.exp(0.4j * np.arange(2000))
    turned = matched_filter(tone.real, [1.0])[500:1500]
    np.testing.assert_allclose(turned, tone[500:1500], atol=2e-3)


def test_finer_samples_pass_through_the_coarse_ones():
    heard = echoes((700, 0.5))
    fine = matched_filter(heard, CALL, oversampling=4)
    assert fine.shape == (16_000,)
    np.testing.assert_allclose(fine[::4], matched_filter(heard, CALL), atol=1e-12)


def test_a_call_without_sound_is_refused():
    with pytest.raises(ValueError, match="not silent"):
        matched_filter(np.ones(9), np.zeros(3))
    with pytest.raises(ValueError, match="oversampling"):
        matched_filter(np.ones(9), np.ones(3), oversampling=0)
