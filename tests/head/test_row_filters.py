# SPDX-License-Identifier: MIT
import numpy as np
import pytest

from sononerf.head.call import call_waveform, sweep_delay
from sononerf.head.front_end import dechirped_spectrogram, echo_samples, range_axis
from sononerf.head.reception import effective_window
from sononerf.head.row_filters import band_mean, row_filters, row_frequencies, row_widths
from sononerf.settings.schema import CallSettings, SpectrogramSettings

SPEED = 343.0


def gammatone(**changes):
    return SpectrogramSettings(kind="gammatone", **changes)


def wide(values, fraction):
    above = np.flatnonzero(values >= fraction * values.max())
    return above[-1] - above[0] + 1


def test_channels_have_equal_ratios_between_the_ends():
    frequency = row_frequencies(gammatone(channels=31))
    np.testing.assert_allclose(frequency[[0, -1]], [10e3, 100e3])
    np.testing.assert_allclose(frequency[1:] / frequency[:-1], 10 ** (1 / 30))


@pytest.mark.parametrize("q", [3.0, 9.26])
def test_a_filter_is_as_wide_as_its_q_says(q):
    """The equivalent rectangular bandwidth is the centre over Q."""
    filters = row_filters(gammatone(q=q))
    transform = abs(np.fft.fft(filters.envelope, 1 << 16)) ** 2
    width = transform.sum(axis=1) / transform[:, 0] * 1e6 / (1 << 16)
    np.testing.assert_allclose(width, filters.frequency / q, rtol=0.02)


@pytest.mark.parametrize("spectrogram", [SpectrogramSettings(), gammatone()])
def test_widths_are_counted_above_half_height(spectrogram):
    filters = row_filters(spectrogram)
    duration, bandwidth = row_widths(spectrogram, filters.frequency)
    for row in (5, 30):
        assert wide(filters.envelope[row], 0.5) == pytest.approx(1e6 * duration[row], abs=2)
        transform = np.fft.fftshift(abs(np.fft.fft(filters.envelope[row], 1 << 16)))
        found = wide(transform, 0.5) * 1e6 / (1 << 16)
        assert found == pytest.approx(bandwidth[row], rel=0.02)


def test_the_length_is_that_of_a_window_as_wide():
    assert row_filters(SpectrogramSettings()).length == 64
    filters = row_filters(gammatone())
    mean = np.sqrt(band_mean((filters.envelope**2).T, filters.frequency))
    assert wide(np.hamming(filters.length), 0.5) == pytest.approx(wide(mean, 0.5), rel=0.05)


@pytest.mark.parametrize("call", [CallSettings(), CallSettings(kind="linear", duration=0.2e-3)])
def test_an_impulse_peaks_at_its_range_in_every_channel(call):
    spectrogram = gammatone(hop=1, frequency_min=42e3 if call.kind == "linear" else 10e3)
    delay = sweep_delay(call, row_frequencies(spectrogram))
    echo = np.zeros((1, echo_samples(spectrogram, SPEED, float(delay.max()))))
    waveform = call_waveform(call, 1e6)
    echo[0, 2000 : 2000 + len(waveform)] = 3.0 * waveform
    found = dechirped_spectrogram(echo, spectrogram, SPEED, delay)[0]
    ranges = range_axis(spectrogram, SPEED)
    late = ranges[found.argmax(axis=0)] - 0.343
    if call.kind == "impulse":
        assert abs(late).max() <= 0.0002  # a sample
        np.testing.assert_allclose(found.max(axis=0), 3.0, rtol=1e-3)
    else:  # a sweep is heard by the filter's delay at its middle, a little after the peak's
        assert abs(late).max() <= 0.004


def test_what_a_channel_reads_before_the_emission_is_silent():
    spectrogram = gammatone(range_min=0.01, range_max=0.2, hop=3)
    ranges = range_axis(spectrogram, SPEED)
    assert ranges[0] < 0.011
    echo = np.random.default_rng(0).normal(size=(1, echo_samples(spectrogram, SPEED)))
    filters = row_filters(spectrogram)
    found = dechirped_spectrogram(echo, spectrogram, SPEED)[0]
    padded = np.pad(echo[0], (-filters.origin, 0))
    sample = np.arange(filters.envelope.shape[1]) / 1e6
    for frame in (0, 40, len(ranges) - 1):
        start = round(ranges[frame] * 2e6 / SPEED)
        part = padded[start : start + filters.envelope.shape[1]]
        for row in (0, 20, 47):
            tone = np.exp(-2j * np.pi * filters.frequency[row] * sample)
            expected = abs((part * filters.envelope[row]) @ tone)
            assert found[frame, row] == pytest.approx(expected, rel=1e-9)


def test_the_effective_window_is_an_impulses_row():
    spectrogram = gammatone(hop=1)
    window = effective_window(CallSettings(), spectrogram)
    echo = np.zeros((1, echo_samples(spectrogram, SPEED)))
    echo[0, 2500] = 1.0
    found = dechirped_spectrogram(echo, spectrogram, SPEED)[0]
    middle = round(2500 - range_axis(spectrogram, SPEED)[0] * 2e6 / SPEED)
    side = (window.shape[1] - 1) // 2
    np.testing.assert_allclose(window, found[middle - side : middle + side + 1].T, atol=1e-9)
    assert window[0, side + 300] > 10 * window[0, side - 300]  # it fades slower than it swells


def test_independent_values_follow_the_band_and_q():
    assert row_filters(gammatone(q=8.0)).looks == pytest.approx(
        2 * row_filters(gammatone(q=4.0)).looks, rel=0.05
    )
    assert row_filters(gammatone(channels=96)).looks == pytest.approx(
        row_filters(gammatone(channels=48)).looks, rel=0.02
    )


def test_a_mean_over_the_band_counts_hertz():
    frequency = np.geomspace(10e3, 100e3, 200)
    # A power that lies above 55 kHz alone fills half of the band, a quarter of the channels.
    power = (frequency > 55e3).astype(float)
    assert band_mean(power, frequency) == pytest.approx(0.5, abs=0.02)
    even = np.random.default_rng(0).random((3, 47))
    axis = row_frequencies(SpectrogramSettings())
    np.testing.assert_array_equal(band_mean(even, axis), even.mean(axis=-1))
    assert band_mean(np.ones((2, 1)), [5e3]).tolist() == [1.0, 1.0]
