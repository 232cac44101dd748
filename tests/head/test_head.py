# SPDX-License-Identifier: MIT
"""One head answers for places, air and lag."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.io import wavfile

from sononerf.geometry.poses import rotation_from_euler
from sononerf.head.front_end import (
    ACTIVE_DB,
    FALSE_ACTIVE_RATE,
    active_level,
    compress,
    expand,
    mae_all_and_active,
)
from sononerf.head.head import Head, PointEcho, own_top
from sononerf.head.reception import (
    air_absorption,
    draw_noise,
    loudest_power,
    noise_level,
    speed_of_sound,
    target_gain,
)
from sononerf.settings.schema import CallSettings, EarSettings, NoiseSettings, SpectrogramSettings


def test_places_are_moved_and_turned_with_the_head():
    head = Head(ears=EarSettings(emitter=(0.02, 0.0, 0.0), left=(0.0, 0.01, 0.0)))
    left = rotation_from_euler(np.pi / 2, 0.0, 0.0)  # looks along y
    emitter, receivers = head.places([1.0, 2.0, 3.0], left)
    np.testing.assert_allclose(emitter, [1.0, 2.02, 3.0])
    np.testing.assert_allclose(receivers, [[0.99, 2.0, 3.0], [1.01, 2.0, 3.0]])


def test_the_air_takes_as_many_decibels_as_it_says():
    head = Head()
    left = np.exp(-2.0 * head.row_absorption)  # of the amplitude after 2 m
    np.testing.assert_allclose(20 * np.log10(left), -2.0 * head.absorption(head.frequency))
    assert -20 * np.log10(left[-1]) == pytest.approx(6.5, rel=0.15)  # 100 kHz, 20 degrees, 50 %


def test_the_mean_lag_is_that_of_the_directions_that_are_heard():
    assert Head().mean_lag == 0.0
    analysis = SpectrogramSettings(frequency_min=10e3, frequency_max=100e3, window=64)
    head = Head(call=CallSettings(kind="linear", duration=1e-3), spectrogram=analysis)
    gains = head.row_gains.beam * head.row_gains.ears
    loud = gains > 0.5 * gains.max()
    assert head.lag[loud].min() < head.mean_lag < head.lag[loud].max()
    assert np.ptp(head.lag[loud]) < 0.2 * np.ptp(head.lag)


def test_the_echo_of_a_point_has_the_spacing_of_samples_and_half_its_power_in_a_resolution():
    head = Head(air={"speed_of_sound": 340.0})
    assert head.point_echo.spacing == pytest.approx(170.0 / head.spectrogram.sampling_rate)
    triangle = np.concatenate((np.arange(0.0, 8.0), np.arange(8.0, -1.0, -1.0))) / 8.0
    echo = PointEcho(window=triangle**2, rows=None, spacing=0.002, looks=1.0)
    assert echo.resolution == pytest.approx(0.018)  # nine of its magnitudes are one half or more


def test_the_top_of_a_window_may_be_its_end():
    rising = np.arange(7.0)
    assert (own_top(rising), own_top(rising[::-1])) == (6, 0)
    assert own_top(np.array([9.0, 0.0, 1.0, 2.0, 3.0, 1.0, 0.0])) == 4


def test_the_shortest_wavelength_is_that_of_the_highest_row():
    head = Head(air={"speed_of_sound": 340.0}, spectrogram={"frequency_max": 80e3})
    assert head.wavelength == pytest.approx(340.0 / head.frequency.max())


def test_a_head_has_a_plane_where_things_stand_on_a_support():
    assert Head().plane is None
    plane = Head(support={"point": [0.0, 0.0, -0.1]}).plane
    assert plane is not None
    assert plane.height(np.array([[0.0, 0.0, 0.3]])) == pytest.approx(0.4)


@pytest.mark.parametrize(
    ("temperature_c", "relative_humidity", "band", "per_kilometre"),
    [
        # ISO 9613-1:1993, table 1, dB/km, at exact mid-band frequencies 1000 * 10**(band / 10).
        (10.0, 0.70, 0, 3.66e0),
        (20.0, 0.70, 0, 4.98e0),
        (20.0, 0.10, 7, 1.33e2),
        (15.0, 0.20, 3, 2.82e1),  # also ISO 9613-2:1996, table 2
        (10.0, 0.70, 9, 1.17e2),
    ],
)
def test_rows_of_the_standard(temperature_c, relative_humidity, band, per_kilometre):
    found = air_absorption(
        1000.0 * 10.0 ** (band / 10.0),
        temperature_c=temperature_c,
        relative_humidity=relative_humidity,
    )
    assert 1000.0 * found == pytest.approx(per_kilometre, rel=5e-3)


def test_ultrasound_as_computed_by_pyfar():
    found = air_absorption([20e3, 50e3, 100e3], temperature_c=20.0, relative_humidity=0.5)
    np.testing.assert_allclose(found, [0.524, 1.661, 3.280], atol=6e-4)


def test_pressure_divides_the_relaxation_frequencies():
    # Everything in the standard depends on f / p and on the molar share of water.
    low = air_absorption(20e3, temperature_c=20.0, relative_humidity=0.25, pressure=101_325.0 / 2)
    high = air_absorption(40e3, temperature_c=20.0, relative_humidity=0.5)
    assert low == pytest.approx(high / 2, rel=1e-9)


@pytest.mark.parametrize(
    ("arguments", "match"),
    [
        ({"temperature_c": 50.1}, "temperature_c"),
        ({"temperature_c": -20.1}, "temperature_c"),
        ({"relative_humidity": 1.01}, "relative_humidity"),
        ({"relative_humidity": -0.01}, "relative_humidity"),
        ({"frequency": 1.1e6}, "frequency / pressure"),
        ({"frequency": 10.0}, "frequency / pressure"),
        ({"frequency": float("nan")}, "frequency / pressure"),
    ],
)
def test_outside_the_standard_is_refused(arguments, match):
    good = {"frequency": 50e3, "temperature_c": 20.0, "relative_humidity": 0.5}
    with pytest.raises(ValueError, match=match):
        air_absorption(**{**good, **arguments})


@pytest.mark.parametrize(
    ("temperature_c", "expected"), [(0.0, 331.3), (20.0, 343.2), (35.0, 351.9)]
)
def test_speed_of_sound(temperature_c, expected):
    assert speed_of_sound(temperature_c) == pytest.approx(expected, abs=0.06)


def test_noise_makes_one_cell_in_a_thousand_active():
    rng = np.random.default_rng(0)
    rms = np.array([[30.0], [50.0]])  # far above the reference, two ears, one frequency
    parts = rng.standard_normal((2, 2, 400_000)) * np.sqrt(0.5)
    magnitude = rms * np.hypot(*parts)  # Rayleigh's distribution
    active = compress(magnitude, 1.0) >= active_level(rms, 1.0)[:, 0]
    assert 0.8 * FALSE_ACTIVE_RATE < active.mean() < 1.2 * FALSE_ACTIVE_RATE


def test_without_noise_or_with_little_of_it_three_decibels_are_active():
    assert active_level(None, 1.0) == ACTIVE_DB
    assert (active_level(np.full((2, 3), 1e-6), 1.0) == ACTIVE_DB).all()


def test_levels_are_expanded_to_what_was_compressed():
    magnitude = np.array([[0.0, 1e-3], [0.5, 40.0]])
    np.testing.assert_allclose(expand(compress(magnitude, 0.2), 0.2), magnitude, rtol=1e-9)
    assert compress(9 * 0.2, 0.2) == 20.0
    with pytest.raises(ValueError, match="reference is 0, expected above 0"):
        compress(magnitude, 0)


def test_a_cell_at_the_active_level_is_active():
    heard, predicted = np.zeros((1, 1, 1, 2)), np.array([[[[ACTIVE_DB, 1.0]]]])
    for pair in ((heard, predicted), (predicted, heard)):
        assert mae_all_and_active(*pair, ACTIVE_DB) == ((ACTIVE_DB + 1.0) / 2, ACTIVE_DB)


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


LONG = {"kind": "linear", "duration": 3e-3, "frequency_start": 90e3, "frequency_end": 30e3}


def test_the_analysis_follows_from_the_call_where_it_is_not_set():
    head, plain = Head(call=LONG), Head(spectrogram={"frequency_min": 30e3, "frequency_max": 90e3})
    analysis = head.spectrogram
    assert (analysis.frequency_min, analysis.frequency_max) == (30e3, 90e3)
    other = [Head(call=LONG, spectrogram={"window": n}).resolution for n in (64, 128, 600, 1000)]
    assert head.resolution < min(other)
    # As many slices and rows make up the echo of a point as under an impulse.
    slices = [one.resolution / (one.range[1] - one.range[0]) for one in (head, plain)]
    assert 0.5 < slices[0] / slices[1] < 2.0
    assert head.window.shape[1] / head.spectrogram.hop < 4 * plain.window.shape[1] / 4
    kept = Head(call=LONG, spectrogram={"window": 128, "hop": 3, "frequency_min": 40e3}).spectrogram
    assert (kept.window, kept.hop, kept.frequency_min) == (128, 3, 40e3)
    assert Head.from_plain(head.plain()).spectrogram == analysis
    assert head.of_impulse().resolution == pytest.approx(plain.resolution)


def test_a_recorded_call_is_analysed_as_a_written_one(tmp_path):
    written = Head(call=LONG)
    file = tmp_path / "call.wav"
    wavfile.write(file, 1_000_000, written.waveform.astype(np.float32))
    recorded = Head(call={"kind": "file", "file": file})
    for name, slack in (("window", 0.1), ("hop", 0.1), ("frequency_min", 0.1)):
        a, b = (getattr(one.spectrogram, name) for one in (recorded, written))
        assert a == pytest.approx(b, rel=slack), name
    assert recorded.resolution == pytest.approx(written.resolution, rel=0.15)
    assert recorded.window.shape[1] < 2 * written.window.shape[1]


def test_precursors_of_a_sweep_reach_as_far_as_the_call():
    assert Head().point_echo.ahead(0.001).size == 0
    ahead = 10 * np.log10(Head(call=LONG).point_echo.ahead(0.004) + 1e-30)
    length = 3e-3 * 343.0 / 2.0 / 0.004
    assert -60.0 < ahead[int(0.5 * length)] < -20.0
    assert ahead[int(1.2 * length) :].max(initial=-300.0) < -100.0
