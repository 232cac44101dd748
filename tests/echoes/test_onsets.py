# SPDX-License-Identifier: MIT
import dataclasses
from types import SimpleNamespace

import numpy as np
import pytest

from sononerf.echoes.detection import FALSE_ALARMS, Onsets, find_onsets
from sononerf.head.front_end import frequency_axis, range_axis
from sononerf.head.head import PointEcho
from sononerf.head.reception import effective_window
from sononerf.settings.schema import CallSettings, SpectrogramSettings

STEP = 0.0007
RANGE = 0.2 + STEP * np.arange(300)
ECHO = PointEcho.of(CallSettings(), SpectrogramSettings(), 343.0)


def echo(middle, power=1.0):
    """Power over range of one echo of a Hamming window of 64 samples."""
    offset = (RANGE - middle) / (31.5 * 343.0 / 2e6)
    window = 0.54 + 0.46 * np.cos(np.pi * offset)
    return power * np.where(np.abs(offset) <= 1, window, 0.0) ** 2


def store_of(poses, train=None):
    """A store of powers (E, R); three frequencies, of which the mean power is looked at."""
    gain = np.array([1.0, 0.3, 2.0])
    gain /= np.sqrt(np.mean(gain**2))
    train = np.arange(len(poses)) if train is None else np.asarray(train)
    return SimpleNamespace(
        range=RANGE,
        frequency=np.array([20e3, 40e3, 60e3]),
        indices=lambda split: {"train": train}[split],
        read_pose=lambda i: np.sqrt(np.asarray(poses[i]))[..., None].astype(np.float32) * gain,
    )


def test_each_ear_has_its_own_onset():
    at = 0.27 + np.linspace(0, STEP, 12)
    heard = find_onsets(store_of([[echo(r), echo(r + 0.0123, 0.01)] for r in at]), ECHO)
    assert heard.power.shape == heard.heard.shape == (12, 2, 300)
    np.testing.assert_allclose(heard.first, np.stack((at, at + 0.0123), axis=1), atol=1e-4)
    # An echo is detected in the slices around its middle, and nowhere else.
    lit = RANGE[heard.heard[0, 0]]
    assert 0.002 < np.ptp(lit) < 0.011
    assert lit[0] < at[0] < lit[-1]


def test_what_is_not_heard_is_unknown():
    silence = np.zeros(len(RANGE))
    heard = find_onsets(store_of([[silence, echo(0.3)], [silence, silence]]), ECHO)
    np.testing.assert_allclose(heard.first, [[-np.inf, 0.3], [-np.inf] * 2], atol=1e-4)
    assert not heard.heard[1].any()


def test_what_is_heard_before_the_nearest_place_is_clutter():
    both = [echo(0.26) + echo(0.32, 0.1)] * 2
    whole = find_onsets(store_of([both, both]), ECHO)
    np.testing.assert_allclose(whole.first, 0.26, atol=1e-4)
    nearest = np.array([[0.30, 0.30], [0.20, 0.35]])
    heard = find_onsets(store_of([both, both]), ECHO, nearest=nearest)
    np.testing.assert_allclose(heard.first, [[0.32, 0.32], [0.26, -np.inf]], atol=1e-4)
    assert not heard.heard[0][:, RANGE < 0.30].any()
    amid = find_onsets(store_of([both]), ECHO, nearest=np.full((1, 2), RANGE[86]))
    np.testing.assert_array_equal(np.flatnonzero(amid.heard[0, 0])[:3], [86, 87, 88])
    np.testing.assert_array_equal(heard.power, whole.power)


def test_only_training_poses_are_asked():
    poses = {1: [echo(0.3)] * 2, 4: [echo(0.35)] * 2}
    heard = find_onsets(store_of(poses, train=[1, 4]), ECHO)
    assert heard.poses.tolist() == [1, 4]
    np.testing.assert_allclose(heard.first[:, 0], [0.3, 0.35], atol=1e-4)


def test_a_point_echo_is_told_by_window_and_band():
    assert ECHO.spacing == pytest.approx(343.0 / 2e6)
    np.testing.assert_allclose(ECHO.window, np.hamming(64) ** 2, rtol=1e-12)
    # A Hamming window is above half of its height for 0.53 of its length.
    assert ECHO.resolution == pytest.approx(0.53 * 64 * ECHO.spacing, rel=0.05)
    narrow = SpectrogramSettings(frequency_min=40e3, frequency_max=41.5e3)
    assert PointEcho.of(CallSettings(), narrow, 343.0).looks == pytest.approx(1.0, abs=0.02)


def noise_power(count):
    """Mean power over the rows of white noise in one window each, (N,)."""
    spectrogram = SpectrogramSettings()
    samples = np.random.default_rng(0).standard_normal((count, spectrogram.window))
    spectrum = np.fft.rfft(samples * np.hamming(spectrogram.window), spectrogram.fft)
    axis = np.fft.rfftfreq(spectrogram.fft, 1 / spectrogram.sampling_rate)
    band = np.isin(np.round(axis), np.round(frequency_axis(spectrogram)))
    assert band.sum() == len(frequency_axis(spectrogram))
    return (np.abs(spectrum[:, band]) ** 2).mean(axis=1)


def test_noise_has_as_many_independent_values_as_its_spread_tells():
    power = noise_power(40_000)
    assert ECHO.looks == pytest.approx(power.mean() ** 2 / power.var(), rel=0.05)


@pytest.mark.parametrize(("found", "by_noise"), [(0, True), (3, True), (4, False), (100, False)])
def test_so_many_onsets_can_be_noise(found, by_noise):
    """Of 200 ears, 0.6 m at 6 mm: noise gives an onset in one ensemble of fifty."""
    first = np.full((100, 2), -np.inf)
    first[:found, 0] = 0.4
    axis = 0.15 + 0.0006 * np.arange(1001)
    heard = Onsets(np.arange(100), axis, np.zeros(0), np.zeros(0, bool), first)
    assert (heard.chance(0.006) > FALSE_ALARMS) == by_noise


def test_the_echo_of_a_sweep_is_that_of_the_rows_it_sounds_in():
    call, spectrogram = CallSettings(kind="linear", frequency_end=40e3), SpectrogramSettings()
    rows = effective_window(call, spectrogram)[frequency_axis(spectrogram) >= 40e3]
    found = PointEcho.of(call, spectrogram, 343.0)
    np.testing.assert_allclose(found.window, (rows**2).mean(axis=0), rtol=1e-12)
    assert found.resolution > ECHO.resolution


def test_lengths_go_with_the_speed_of_sound():
    slow, fast = (PointEcho.of(CallSettings(), SpectrogramSettings(), c) for c in (343.0, 1029.0))
    assert fast.resolution == pytest.approx(3 * slow.resolution)
    assert fast.looks == slow.looks


@pytest.mark.parametrize("tilt", [-1.0, 0.0, 1.0])
def test_an_onset_does_not_depend_on_which_channels_are_loud(tilt):
    """Low channels of a gammatone swell slowly: an echo that they make up begins early."""
    spectrogram = SpectrogramSettings(kind="gammatone", range_min=0.2, range_max=0.4)
    point = PointEcho.of(CallSettings(), spectrogram, 343.0)
    axis, frequency = range_axis(spectrogram, 343.0), frequency_axis(spectrogram)
    window = effective_window(CallSettings(), spectrogram)
    offset = (np.arange(window.shape[1]) - (window.shape[1] - 1) / 2) * 343.0 / 2e6
    at = 0.3 + np.linspace(0, 0.0007, 12)
    gain = (frequency / 30e3) ** tilt
    rows = [
        gain * np.stack([np.interp(axis - r, offset, row, left=0, right=0) for row in window], 1)
        for r in at
    ]
    store = SimpleNamespace(
        range=axis,
        frequency=frequency,
        indices=lambda split: np.arange(len(at)),
        read_pose=lambda i: rows[i][None].astype(np.float32),
    )
    first = find_onsets(store, point).first[:, 0]
    np.testing.assert_allclose(first, at, atol=3e-4)
    alike = dataclasses.replace(point, rows=None)
    if tilt < 0:
        assert (find_onsets(store, alike).first[:, 0] < at - 1e-3).all()
