# SPDX-License-Identifier: MIT


import numpy as np
import pytest
import scipy.signal

from sononerf.head.call import call_waveform, covered, emit, has_ghosts, sweep_delay, sweep_rate
from sononerf.settings.schema import CallSettings

SWEEPS = [
    (kind, *ends)
    for kind in ("linear", "hyperbolic")
    for ends in ((150e3, 40e3), (30e3, 90e3))  # down and up
]


def sweep(kind, start, end, **more):
    return CallSettings(kind=kind, frequency_start=start, frequency_end=end, **more)


def test_an_impulse_is_one_sample_emitted_at_once():
    call = CallSettings()
    np.testing.assert_array_equal(call_waveform(call, 1e6), [1.0])
    np.testing.assert_array_equal(sweep_delay(call, [10e3, 100e3]), 0.0)
    np.testing.assert_array_equal(sweep_rate(call, [10e3, 100e3]), np.inf)
    assert covered(call, [1.0, 1e6]).all()


@pytest.mark.parametrize(("kind", "start", "end"), SWEEPS)
def test_sweep_is_scipys_chirp_under_its_tukey_window(kind, start, end):
    found = call_waveform(sweep(kind, start, end, duration=1e-3, taper=0.3), 1e6)
    time = np.arange(1001) / 1e6
    expected = scipy.signal.chirp(time, start, 1e-3, end, method=kind)
    np.testing.assert_allclose(found, expected * scipy.signal.windows.tukey(1001, 0.3), atol=1e-9)


def test_harmonics_have_multiples_of_the_fundamentals_phase():
    call = sweep("hyperbolic", 80e3, 20e3, duration=1e-3, taper=0.0, harmonics=(1.0, 0.5, 0.0, 2.0))
    time = np.arange(1001) / 1e6
    expected = sum(
        amplitude * scipy.signal.chirp(time, 80e3 * h, 1e-3, 20e3 * h, method="hyperbolic")
        for h, amplitude in ((1, 1.0), (2, 0.5), (4, 2.0))
    )
    np.testing.assert_allclose(call_waveform(call, 1e6), expected / 3.5, atol=1e-8)


def test_a_call_that_ends_between_two_samples_is_silent_after_its_end():
    found = call_waveform(sweep("linear", 90e3, 40e3, duration=100.5e-6, taper=0.0), 1e6)
    assert len(found) == 102
    assert found[-1] == 0.0
    assert found[-2] != 0.0


@pytest.mark.parametrize(("kind", "start", "end"), SWEEPS)
def test_delay_is_when_the_instantaneous_frequency_passes(kind, start, end):
    time = np.linspace(0.0, 3e-3, 50)
    if kind == "linear":
        passing = start + (end - start) * time / 3e-3
    else:  # as SciPy's manual has it
        passing = start * end * 3e-3 / ((start - end) * time + end * 3e-3)
    call = sweep(kind, start, end, duration=3e-3)
    np.testing.assert_allclose(sweep_delay(call, passing), time, atol=1e-15)


@pytest.mark.parametrize(("kind", "start", "end"), SWEEPS)
@pytest.mark.parametrize("harmonics", [(1.0,), (0.0, 0.0, 1.0)])
def test_rate_is_the_slope_of_the_delay(kind, start, end, harmonics):
    call = sweep(kind, start, end, harmonics=harmonics)
    frequency = len(harmonics) * np.linspace(45e3, 85e3, 9)
    slope = sweep_delay(call, frequency + 1.0) - sweep_delay(call, frequency - 1.0)
    np.testing.assert_allclose(sweep_rate(call, frequency), 2.0 / abs(slope), rtol=1e-6)


@pytest.mark.parametrize(
    ("harmonics", "frequency", "milliseconds", "is_covered"),
    [
        ((1, 1), 80e3, 0.0, True),  # by the fundamental, though the second's end is there too
        ((0, 1), 80e3, 1.0, True),
        ((1, 1), 100e3, 0.75, True),  # the second's, 50 kHz of the fundamental
        ((1, 1), 20e3, 1.0, False),  # the nearest ends
        ((1, 1), 200e3, 0.0, False),
        ((1, 0, 1), 90e3, 0.0, False),  # the gap up to 120 kHz, nearer to the fundamental's start
        ((1, 0, 1), 115e3, 1.0, False),  # nearer to the third's end
    ],
)
def test_the_lowest_harmonic_that_covers_a_frequency_says_when(
    harmonics, frequency, milliseconds, is_covered
):
    call = sweep("linear", 80e3, 40e3, duration=1e-3, harmonics=harmonics)
    assert 1e3 * sweep_delay(call, [frequency])[0] == pytest.approx(milliseconds, abs=1e-12)
    assert covered(call, [frequency])[0] == is_covered


def test_emission_is_a_convolution():
    generator = np.random.default_rng(0)
    responses, waveform = generator.normal(size=(2, 300)), generator.normal(size=40)
    expected = [np.convolve(row, waveform) for row in responses]
    np.testing.assert_allclose(emit(responses, waveform), expected, atol=1e-12)
    np.testing.assert_array_equal(emit(responses, np.ones(1)), responses)


@pytest.mark.parametrize(
    ("kind", "harmonics", "down", "up"),
    [
        ("linear", (1.0, 0.5), 1, 2),
        ("linear", (1.0, 0.3), 1, 1),  # the second is swept over twice as fast: 13 dB fainter
        ("linear", (0.3, 1.0), 1, 2),
        ("linear", (0.15, 1.0), 2, 2),
        ("hyperbolic", (1.0, 0.2), 1, 2),  # and here half as fast
        ("hyperbolic", (1.0, 0.15), 1, 1),
    ],
)
def test_of_overlapping_harmonics_the_first_is_dechirped(kind, harmonics, down, up):
    """A point's other echoes then lie behind it, unless they are faint."""
    frequency = np.linspace(60e3, 75e3, 9)
    for number, start, end in ((down, 90e3, 25e3), (up, 25e3, 90e3)):
        call = sweep(kind, start, end, harmonics=harmonics, duration=1e-3)
        alone = call.model_copy(update={"harmonics": tuple(float(h == number) for h in (1, 2))})
        np.testing.assert_array_equal(sweep_delay(call, frequency), sweep_delay(alone, frequency))
        np.testing.assert_array_equal(sweep_rate(call, frequency), sweep_rate(alone, frequency))
        assert has_ghosts(call, frequency)
        assert not has_ghosts(call, [30e3, 40e3])


def test_a_harmonic_that_fades_out_is_passed_over():
    call = sweep("linear", 90e3, 25e3, harmonics=(1.0, 0.5), duration=1e-3)
    assert sweep_delay(call, [89.9e3])[0] > 0.6e-3  # the second's, long after the first's start


CALL = call_waveform(CallSettings(kind="linear", duration=1e-3, frequency_start=90e3), 1e6)


def echoes(*delays_and_gains, samples=4000):
    heard = np.zeros(samples)
    for delay, gain in delays_and_gains:
        heard[delay : delay + len(CALL)] += gain * CALL
    return heard
