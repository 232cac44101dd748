# SPDX-License-Identifier: MIT
import logging

import numpy as np
import pytest
import scipy.signal

from sononerf.head.call import sweep_delay
from sononerf.head.front_end import dechirped_spectrogram, echo_samples, frequency_axis, range_axis
from sononerf.head.head import Head
from sononerf.head.reception import best_window, effective_window, row_duration, warn_of_call
from sononerf.settings.schema import CallSettings, NoiseSettings, SpectrogramSettings

SPEED = 343.0
ANALYSIS = SpectrogramSettings(frequency_min=40e3)
HOP = 4e-6  # s
SWEEPS = [(kind, length) for kind in ("linear", "hyperbolic") for length in (0.2e-3, 1e-3, 3e-3)]


def spectrogram(**changes):
    return SpectrogramSettings.model_validate({**ANALYSIS.model_dump(), **changes})


def reception(call=None, noise=None, **changes):
    return Head(
        call=call or CallSettings(),
        spectrogram=spectrogram(**changes),
        noise=noise or NoiseSettings(),
    )


def impulse(found, at=2500, height=1.0):
    echo = np.zeros((2, found.samples))
    echo[:, at] = height
    return echo


def point_echo(call, delay, samples):
    """Sweep from `delay` on, between two samples too; SciPy's, under a cosine-tapered envelope."""
    time = np.arange(samples) / 1e6 - delay
    flank = call.taper * call.duration / 2
    inside = np.clip(np.minimum(time, call.duration - time) / flank, 0.0, 1.0)
    ends = call.frequency_start, call.duration, call.frequency_end
    swept = scipy.signal.chirp(np.clip(time, 0.0, call.duration), *ends, method=call.kind)
    return swept * np.sin(np.pi / 2 * inside) ** 2


def peak_and_width(time, row):
    """Where a row is greatest, and for how long it is above half of that.

    A row's top is so flat that the sweep's mirror image at negative frequencies, 40 dB below,
    moves the very greatest value by microseconds; the vertex of a parabola through the top's
    decibels is not moved.
    """
    level = 20 * np.log10(row / row.max())
    top = level > -0.3
    bend, slope, _ = np.polyfit(time[top] - time[row.argmax()], level[top], 2)
    above = np.flatnonzero(row >= row.max() / 2)
    first, last = above[0], above[-1]
    half = row.max() / 2
    start = np.interp(half, row[first - 1 : first + 1], time[first - 1 : first + 1])
    end = np.interp(-half, -row[last : last + 2], time[last : last + 2])
    return time[row.argmax()] - slope / bend / 2, end - start


def measured(call, window, delay=3000.37e-6):
    """Peak's offset and duration (s) of a point echo in the rows that the sweep fills, and theirs.

    Those are the frequencies whose main lobe lies within what is emitted at full height.
    """
    found = reception(call, window=window, hop=1, range_min=0.25, range_max=0.9)
    echo = point_echo(call, delay, found.samples)[None]
    magnitude = dechirped_spectrogram(echo, found.spectrogram, SPEED, found.delay)[0]
    time = 2 * range_axis(found.spectrogram, SPEED) / SPEED
    frequency = frequency_axis(found.spectrogram)
    lobe = 2 * found.spectrogram.sampling_rate / window
    swept = np.linspace(40e3, 150e3, 5000)
    from_end = call.duration / 2 - abs(sweep_delay(call, swept) - call.duration / 2)
    swept = swept[from_end > call.taper * call.duration / 2]
    filled = (frequency - lobe > swept.min()) & (frequency + lobe < swept.max())
    assert filled.sum() > 10
    peak, duration = np.transpose([peak_and_width(time, row) for row in magnitude.T[filled]])
    return peak - delay, duration, frequency[filled]


@pytest.mark.parametrize("best", [False, True])
@pytest.mark.parametrize("ends", [(150e3, 40e3), (40e3, 150e3)])
@pytest.mark.parametrize(("kind", "duration"), SWEEPS)
def test_a_point_echo_is_dechirped(kind, duration, ends, best):
    """It peaks at its own delay in every row, and lasts as briefly as window and sweep allow."""
    call = CallSettings(
        kind=kind, duration=duration, frequency_start=ends[0], frequency_end=ends[1]
    )
    window = best_window(call, ANALYSIS) if best else 64
    offset, lasts, frequency = measured(call, window)
    assert abs(offset).max() < HOP
    expected = row_duration(call, spectrogram(window=window), frequency)
    assert (lasts / expected).max() < 1.1
    assert (lasts / expected).min() > 0.9


@pytest.mark.parametrize(("kind", "duration"), SWEEPS)
def test_the_best_window_keeps_a_point_echo_shortest(kind, duration):
    call = CallSettings(kind=kind, duration=duration)
    best = best_window(call, ANALYSIS)
    frequency = np.maximum(frequency_axis(ANALYSIS), 40e3)  # the first bin lies a little below

    def lasts(window):
        rows = row_duration(call, spectrogram(window=window, fft=1024), frequency)
        return np.sqrt(np.mean(rows**2))

    assert min(range(16, 600), key=lasts) == pytest.approx(best, abs=1)


def test_an_impulse_without_noise_is_analysed_to_the_bit_as_it_came():
    found = reception()
    echo = np.random.default_rng(0).normal(size=(2, found.samples))
    waveform, magnitude = found.receive(echo, seed=1)
    np.testing.assert_array_equal(waveform, echo)
    np.testing.assert_array_equal(magnitude, dechirped_spectrogram(echo, found.spectrogram, SPEED))


def test_a_sweep_is_emitted_and_dechirped():
    call = CallSettings(kind="hyperbolic", duration=1e-3)
    found = reception(call, window=237)
    waveform, magnitude = found.receive(impulse(found), seed=1)
    np.testing.assert_allclose(waveform[0], point_echo(call, 2500e-6, found.samples), atol=1e-9)
    assert found.samples == echo_samples(found.spectrogram, SPEED, found.delay.max())
    peaks = range_axis(found.spectrogram, SPEED)[magnitude[1].argmax(axis=0)]
    # Within two hops: the greatest value of a flat top is not its middle. The first row lies
    # on the sweep's end.
    assert abs(peaks - 2500e-6 * SPEED / 2)[4:].max() < 2 * HOP * SPEED / 2


def test_noise_is_relative_to_the_target():
    # An impulse's share of energy in the band equals white noise's, so over one window of 64
    # the noise is that much below the target's echo of height 0.01 / 0.5**2.
    noise = NoiseSettings(snr_db=(20.0, 0.0), target_strength_db=-40.0, target_distance=0.5)
    found = reception(noise=noise, frequency_min=10e3)
    waveform, _ = found.receive(np.zeros((2, found.samples)), seed=5)
    height = 0.01 / 0.5**2 / np.sqrt(64)
    np.testing.assert_allclose(waveform.std(axis=1), [height / 10, height], rtol=0.04)


def test_noise_is_as_loud_for_a_sweep_as_its_echo_is():
    noise = NoiseSettings(snr_db=0.0, target_strength_db=-40.0)
    call = CallSettings(kind="linear", frequency_start=95e3, taper=1.0)
    found = reception(call, noise)
    height = 0.01 / 0.4**2  # of the sweep; under a Hann window its mean power is 3/16 of its square
    waveform, _ = found.receive(np.zeros((2, found.samples)), seed=5)
    within_band = waveform.var(axis=1) * (100e3 - 40e3) / 500e3
    np.testing.assert_allclose(within_band, height**2 * 3 / 16, rtol=0.06)


def test_noise_relative_to_the_pose_follows_its_echo():
    noise = NoiseSettings(snr_db=10.0, relative_to="pose")
    found = reception(noise=noise)
    echo = impulse(found)
    echo[1] *= 0.0
    one, silent = found.receive(echo, seed=5)[0] - echo
    ten = found.receive(10 * echo, seed=5)[0][0] - 10 * echo[0]
    np.testing.assert_allclose(ten, 10 * one, rtol=1e-6)
    np.testing.assert_array_equal(silent, 0.0)
    assert one.std() == pytest.approx(np.sqrt(0.1 / 64), rel=0.05)
    assert abs(one[2500]) < 0.3  # the echo, of height 1, is there too


def test_noise_depends_on_the_seed_alone():
    found = reception(noise=NoiseSettings(snr_db=0.0))
    one = found.receive(impulse(found), seed=1)[1]
    found.receive(impulse(found), seed=2)
    np.testing.assert_array_equal(found.receive(impulse(found), seed=1)[1], one)
    assert abs(found.receive(impulse(found), seed=3)[1] - one).max() > 0


@pytest.mark.parametrize(("kind", "window"), [("linear", 177), ("hyperbolic", 237), ("linear", 64)])
def test_the_effective_window_is_a_point_echos_row(kind, window):
    call = CallSettings(kind=kind, duration=1e-3)
    found = effective_window(call, spectrogram(window=window))
    count = found.shape[1]
    np.testing.assert_allclose(found, found[:, ::-1])
    np.testing.assert_allclose(found[:, [(count - 1) // 2, count // 2]], 1.0)
    heard = reception(call, window=window, hop=1)
    rows = heard.receive(impulse(heard), seed=0)[1][0]
    time = 2 * range_axis(heard.spectrogram, SPEED) / SPEED - 2500e-6
    offset = (np.arange(count) - (count - 1) / 2) / 1e6
    for row in (16, 20):  # 70 and 78 kHz
        there = np.interp(offset, time, rows[:, row])
        there = np.sqrt((there**2 + there[::-1] ** 2) / 2)
        np.testing.assert_allclose(found[row], there / there[count // 2], atol=2e-3)
        assert found[row, 0] < 0.1


def test_a_call_that_suits_its_analysis_is_not_remarked_upon(caplog):
    warn_of_call(CallSettings(), SpectrogramSettings())
    warn_of_call(CallSettings(kind="linear"), ANALYSIS)
    assert caplog.records == []


def test_a_slow_sweep_wants_a_longer_window(caplog):
    call = CallSettings(kind="linear", duration=3e-3)
    warn_of_call(call, ANALYSIS)
    (record,) = caplog.records
    assert (record.name, record.levelno) == ("sononerf", logging.WARNING)
    message = record.getMessage()
    assert "lasts 772 µs in a window of 64 samples and 228 µs" in message
    assert message.endswith("set spectrogram.window=306")
    caplog.clear()
    warn_of_call(call.model_copy(update={"duration": 20e-3}), ANALYSIS)
    assert caplog.records[0].getMessage().endswith("window=789 and spectrogram.fft=1024")


def test_a_window_that_is_far_too_long_is_told_too(caplog):
    warn_of_call(CallSettings(kind="linear", duration=0.2e-3), spectrogram(window=200))
    assert caplog.records[0].getMessage().endswith("set spectrogram.window=79")


def test_bands_that_the_call_does_not_cover_are_named(caplog):
    call = CallSettings(
        kind="linear", frequency_start=45e3, frequency_end=30e3, harmonics=(1.0, 1.0)
    )
    warn_of_call(call, SpectrogramSettings(window=160))
    (record,) = caplog.records
    message = record.getMessage()
    assert message.startswith("the call does not cover 10.0 to 29.3 kHz, 46.9 to 58.6 kHz, 91.8")
