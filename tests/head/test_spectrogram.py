# SPDX-License-Identifier: MIT


import numpy as np
import pytest
import scipy.signal

from sononerf.head.call import call_waveform, sweep_delay
from sononerf.head.front_end import (
    compress,
    dechirped_spectrogram,
    echo_samples,
    frequency_axis,
    range_axis,
    smearing,
)
from sononerf.settings.schema import CallSettings, SpectrogramSettings

DEFAULT = SpectrogramSettings()


def test_default_axes_are_the_papers():
    frequency, ranges = frequency_axis(DEFAULT), range_axis(DEFAULT, 343.0)
    assert len(frequency) == 47
    np.testing.assert_allclose(frequency[[0, -1]], [9765.625, 99609.375])
    assert len(ranges) == 875
    np.testing.assert_allclose(np.diff(ranges), 4e-6 * 343.0 / 2)
    assert 0.15 <= ranges[0] < 0.15 + 0.000686
    assert 0.75 - 0.000686 < ranges[-1] <= 0.75


@pytest.mark.parametrize(
    "settings",
    [
        DEFAULT,
        SpectrogramSettings(window=100, hop=7, fft=128, range_min=0.001, range_max=0.3),
        SpectrogramSettings(sampling_rate=450e3, frequency_min=20e3, frequency_max=85e3),
    ],
)
def test_equals_scipys(settings):
    echo = np.random.default_rng(0).normal(size=(2, echo_samples(settings, 343.0) + 50))
    frequency, time, expected = scipy.signal.spectrogram(
        echo,
        settings.sampling_rate,
        window=scipy.signal.windows.hamming(settings.window, sym=True),
        noverlap=settings.window - settings.hop,
        nfft=settings.fft,
        detrend=False,
        mode="magnitude",
        scaling="spectrum",
    )
    window_sum = scipy.signal.windows.hamming(settings.window, sym=True).sum()
    # SciPy's frame times are window / 2, ours the centre between the samples.
    ranges = (time - 0.5 / settings.sampling_rate) * 343.0 / 2
    kept = (ranges >= settings.range_min) & (ranges <= settings.range_max)
    np.testing.assert_allclose(ranges[kept], range_axis(settings, 343.0), rtol=1e-12)
    bins = [np.abs(frequency - f).argmin() for f in frequency_axis(settings)]
    expected = np.moveaxis(expected[:, bins], 1, 2)[:, kept] * window_sum
    np.testing.assert_allclose(dechirped_spectrogram(echo, settings, 343.0), expected, atol=1e-12)


def test_a_sample_peaks_at_its_range_in_all_frequencies_alike():
    echo = np.zeros((1, echo_samples(DEFAULT, 343.0)))
    echo[0, 2000] = 3.0
    found = dechirped_spectrogram(echo, DEFAULT, 343.0)[0]
    ranges = range_axis(DEFAULT, 343.0)
    # The range of sample 2000 is 0.343 m; frames stand half a hop off it at most.
    assert abs(ranges[found[:, 20].argmax()] - 0.343) <= 0.000343
    np.testing.assert_allclose(found.max(axis=0), 3.0, rtol=0.01)
    assert found[np.abs(ranges - 0.343) > 0.0056].max() == 0.0


def test_speed_of_sound_scales_the_ranges():
    np.testing.assert_allclose(np.diff(range_axis(DEFAULT, 1500.0)), 4e-6 * 750.0)


def test_short_echo_is_refused():
    needed = echo_samples(DEFAULT, 343.0)
    assert dechirped_spectrogram(np.zeros((2, needed)), DEFAULT, 343.0).shape == (2, 875, 47)
    with pytest.raises(ValueError, match=f"needs {needed}"):
        dechirped_spectrogram(np.zeros((2, needed - 1)), DEFAULT, 343.0)


def test_no_frame_between_the_ranges_is_refused():
    with pytest.raises(ValueError, match="no analysis frame"):
        range_axis(SpectrogramSettings(hop=1000, range_min=0.2, range_max=0.21), 343.0)


def test_a_row_is_advanced_by_its_own_delay():
    delay = np.arange(47) * 3e-6  # whole samples, not whole hops
    needed = echo_samples(DEFAULT, 343.0, delay[-1])
    assert needed == echo_samples(DEFAULT, 343.0) + 138
    echo = np.random.default_rng(0).normal(size=(2, needed))
    found = dechirped_spectrogram(echo, DEFAULT, 343.0, delay)
    for row, advance in enumerate(3 * np.arange(47)):
        expected = dechirped_spectrogram(echo[:, advance:], DEFAULT, 343.0)
        np.testing.assert_allclose(found[..., row], expected[..., row], atol=1e-11)


def test_a_row_is_advanced_between_two_samples():
    half = np.full(47, 0.5e-6)
    time = np.arange(2 * echo_samples(DEFAULT, 343.0, 0.5e-6) + 2) / 2e6
    fine = np.exp(-0.5 * ((time - 2.1e-3) / 5e-6) ** 2) * np.cos(2 * np.pi * 60e3 * time)
    between = dechirped_spectrogram(fine[None, 1::2], DEFAULT, 343.0)
    found = dechirped_spectrogram(fine[None, ::2], DEFAULT, 343.0, half)
    np.testing.assert_allclose(found, between, atol=1e-9 * between.max())
    assert (
        abs(dechirped_spectrogram(fine[None, ::2], DEFAULT, 343.0) - between).max()
        > 0.01 * between.max()
    )


def test_no_delay_is_no_change_to_the_bit():
    echo = np.random.default_rng(0).normal(size=(2, echo_samples(DEFAULT, 343.0)))
    expected = dechirped_spectrogram(echo, DEFAULT, 343.0)
    np.testing.assert_array_equal(
        dechirped_spectrogram(echo, DEFAULT, 343.0, np.zeros(47)), expected
    )


def test_wrong_delays_are_refused():
    echo = np.zeros((2, echo_samples(DEFAULT, 343.0, 1e-3) - 1))
    with pytest.raises(ValueError, match=f"needs {echo.shape[1] + 1}"):
        dechirped_spectrogram(echo, DEFAULT, 343.0, np.full(47, 1e-3))
    with pytest.raises(ValueError, match="negative"):
        dechirped_spectrogram(echo, DEFAULT, 343.0, np.full(47, -1e-6))


def test_compression_on_paper():
    np.testing.assert_allclose(
        compress([0.0, 1e-3, 9e-3, 0.999], 1e-3), [0.0, 6.0206, 20.0, 60.0], atol=1e-4
    )
    with pytest.raises(ValueError, match="reference"):
        compress(1.0, 0.0)


SPEED = 343.0


def notched(frequency):
    """Gain with a notch of 8 kHz at 60 kHz."""
    return 1.0 - 0.8 * np.exp(-0.5 * ((frequency - 60e3) / 8e3) ** 2)


def heard(call, spectrogram):
    """Rows (2, R, F) of a call as it is and through the notch, their axis of time, s."""
    delay = sweep_delay(call, frequency_axis(spectrogram))
    echo = np.zeros(echo_samples(spectrogram, SPEED, float(delay.max())))
    waveform = call_waveform(call, 1e6)
    echo[2000 : 2000 + len(waveform)] = waveform
    gain = notched(np.fft.rfftfreq(len(echo), 1e-6))
    both = np.stack((echo, np.fft.irfft(np.fft.rfft(echo) * gain, len(echo))))
    time = 2 * range_axis(spectrogram, SPEED) / SPEED - 2000e-6
    return dechirped_spectrogram(both, spectrogram, SPEED, delay), time


@pytest.mark.parametrize("q", [2.0, 4.0, 9.0])
def test_a_gammatones_channel_hears_the_mean_about_its_frequency(q):
    spectrogram = SpectrogramSettings(kind="gammatone", q=q, hop=1)
    found = smearing(CallSettings(), spectrogram)
    assert found.later is None
    np.testing.assert_allclose(abs(found.weight.sum(axis=1)), 1.0)
    rows, time = heard(CallSettings(), spectrogram)
    expected = rows[1][np.abs(time).argmin()]
    gain = abs((found.weight * notched(found.frequency[found.rows])).sum(axis=1))
    np.testing.assert_allclose(gain, expected, atol=0.02)
    raw = notched(np.geomspace(10e3, 100e3, 48))
    assert abs(raw - expected).max() > 0.05


def test_a_gammatones_channel_hears_the_power_of_a_sweep():
    spectrogram = SpectrogramSettings(kind="gammatone", frequency_min=45e3, hop=1)
    call = CallSettings(kind="linear", duration=1e-3, frequency_end=25e3)
    found = smearing(call, spectrogram)
    np.testing.assert_allclose(found.weight.sum(axis=1), 1.0)
    rows, time = heard(call, spectrogram)
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


def test_above_half_the_sampling_rate_there_is_nothing_to_hear():
    rate = 220e3
    spectrogram = SpectrogramSettings(
        kind="gammatone", sampling_rate=rate, frequency_max=100e3, hop=1, window=64, fft=64
    )
    found = smearing(CallSettings(), spectrogram)
    beyond = found.frequency >= rate / 2
    assert beyond.any()
    np.testing.assert_allclose(found.frequency[beyond], rate / 2)
    assert (np.abs(found.weight[beyond[found.rows]]) == 0).all()
    assert (np.abs(found.weight).max(axis=1) > 0).all()
