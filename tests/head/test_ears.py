# SPDX-License-Identifier: MIT


import numpy as np
import pytest
from scipy.interpolate import RegularGridInterpolator

from sononerf.errors import InputError, SettingsError
from sononerf.geometry.directions import fibonacci_sphere
from sononerf.head.call import call_waveform, sweep_delay
from sononerf.head.directivity_files import write_sofa
from sononerf.head.ears import (
    SPEED,
    analysed_ears,
    beam_gain,
    ear,
    ear_gain,
    ear_tables,
    piston,
    receiver_places,
)
from sononerf.head.front_end import dechirped_spectrogram, echo_samples, frequency_axis, range_axis
from sononerf.settings.schema import CallSettings, EarSettings, SpectrogramSettings
from tests.head.directivity.patterns import (
    AZIMUTH,
    ELEVATION,
    PLACES,
    batslam_fields,
    pair,
    sononerf_fields,
    write_v5,
    write_v73,
)

FREQUENCY = np.array([10e3, 40e3, 60e3, 100e3])


@pytest.fixture(scope="module")
def ears():
    return ear_tables(EarSettings(), FREQUENCY)


def direction(azimuth_deg, elevation_deg):
    a, e = np.radians(azimuth_deg), np.radians(elevation_deg)
    return np.array([[np.cos(e) * np.cos(a), np.cos(e) * np.sin(a), np.sin(e)]])


def test_grid_holds_both_ends_of_both_axes(ears):
    assert ears.beam.shape == (4, 91, 181)
    assert ears.ears.shape == (2, 4, 91, 181)
    np.testing.assert_allclose(np.degrees(ears.azimuth[[0, 90, -1]]), [-180, 0, 180])
    np.testing.assert_allclose(np.degrees(ears.elevation[[0, 45, -1]]), [-90, 0, 90], atol=1e-12)
    np.testing.assert_array_equal(ears.ears[..., 0], ears.ears[..., -1])


def test_right_ear_is_the_left_ones_mirror_image(ears):
    np.testing.assert_allclose(ears.ears[0], ears.ears[1][:, :, ::-1], rtol=1e-6)
    np.testing.assert_allclose(ears.positions[0] * [1, -1, 1], ears.positions[1])
    assert ears.positions[0, 1] > 0.0  # ear 0 is the left one


def test_left_ear_hears_best_on_its_axis(ears):
    # 10 kHz lies 30 kHz and more from the notch at any elevation near the axis.
    row, column = np.unravel_index(ears.ears[0, 0].argmax(), (91, 181))
    assert np.degrees(ears.azimuth[column]) == pytest.approx(25.0, abs=1.01)
    assert np.degrees(ears.elevation[row]) == pytest.approx(10.0, abs=1.01)
    assert ears.ears.min() >= 0.0
    assert ears.ears.max() <= 1.0


def test_width_of_an_ear_at_50_kilohertz():
    ears = ear_tables(EarSettings(azimuth_deg=0, elevation_deg=0, notch_depth=0), [50e3, 200e3])
    gain = ear_gain(ears, 0, np.concatenate([direction(44, 0), direction(0, -44)]))
    expected = np.exp(-0.5 * (44 / 45) ** 2 * np.array([1.0, 4.0]))
    np.testing.assert_allclose(gain, np.stack([expected, expected]), rtol=1e-5)


@pytest.mark.parametrize(("elevation_deg", "notch"), [(0.0, 60e3), (60.0, 80e3), (-60.0, 40e3)])
def test_notch_rises_with_elevation(elevation_deg, notch):
    frequency = np.arange(20e3, 110e3, 500.0)
    deep, flat = (
        ear_gain(ear_tables(EarSettings(notch_depth=d), frequency), 0, direction(0, elevation_deg))
        for d in (0.8, 0.0)
    )
    ratio = (deep / flat)[0]
    assert frequency[ratio.argmin()] == pytest.approx(notch, abs=1.0)
    assert ratio.min() == pytest.approx(0.2, rel=1e-4)


def test_beam_has_the_pistons_null_where_the_book_says():
    # First null of a piston: ka sin(theta) = 3.8317.
    radius = 3.8317 * 343.0 / (2 * np.pi * 100e3) / np.sin(np.radians(40.0))
    ears = ear_tables(EarSettings(beam_radius=radius), [100e3])
    gain = beam_gain(ears, np.concatenate([direction(0, 0), direction(40, 0), direction(0, 40)]))
    assert gain[0, 0] == pytest.approx(1.0, abs=1e-6)
    np.testing.assert_allclose(gain[1:, 0], 0.0, atol=1e-4)


def test_look_up_equals_scipys_interpolator(ears):
    directions = np.concatenate([fibonacci_sphere(500), -np.eye(3), np.eye(3)])
    azimuth = np.arctan2(directions[:, 1], directions[:, 0])
    elevation = np.arcsin(directions[:, 2])
    places = np.stack([elevation, azimuth], axis=1)
    for table, found in (
        (ears.beam, beam_gain(ears, directions)),
        (ears.ears[0], ear_gain(ears, 0, directions)),
        (ears.ears[1], ear_gain(ears, 1, directions)),
    ):
        oracle = RegularGridInterpolator((ears.elevation, ears.azimuth), np.moveaxis(table, 0, -1))
        np.testing.assert_allclose(found, oracle(places), atol=1e-6)


def test_analysed_ears_are_what_the_window_makes_of_an_echo():
    """An echo in the middle of the window, filtered by an ear, through window and transform."""
    spectrogram = SpectrogramSettings()
    head = EarSettings(beam_radius=0.0)
    wanted = frequency_axis(spectrogram)
    heard, lag = analysed_ears(head, CallSettings(), spectrogram)
    assert lag is None
    step = spectrogram.sampling_rate / spectrogram.fft
    fine = ear_tables(head, np.arange(1, spectrogram.fft // 2 + 1) * step)
    row, column = 40, 95  # a little below and to the left of straight ahead
    gain = fine.ears[0, :, row, column].astype(float)
    spectrum = np.concatenate((gain[:1], gain))  # below the first bin as at it
    middle = (spectrogram.window - 1) / 2
    phase = np.exp(-2j * np.pi * np.arange(len(spectrum)) / spectrogram.fft * middle)
    echo = np.fft.irfft(spectrum * phase, spectrogram.fft)[: spectrogram.window]
    window = np.hamming(spectrogram.window)
    magnitude = np.abs(np.fft.rfft(echo * window, spectrogram.fft))
    first = round(wanted[0] / step)
    expected = magnitude[first : first + len(wanted)]
    # A notch of 8 kHz is filled by a window that resolves 28 kHz: this is no small matter.
    raw = gain[first - 1 : first - 1 + len(wanted)]
    assert np.abs(raw - expected).max() > 0.2
    # Side lobes beyond two main lobes are left out.
    np.testing.assert_allclose(heard.ears[0, :, row, column], expected, atol=0.01)
    assert heard.beam.max() == pytest.approx(1.0, abs=1e-5)


@pytest.mark.parametrize("kind", ["linear", "hyperbolic"])
def test_analysed_ears_are_what_a_sweeps_rows_hear(kind):
    """A sweep, filtered by an ear, through the dechirped spectrogram: each row's power and time."""
    spectrogram = SpectrogramSettings(window=150, hop=1, frequency_min=45e3, range_max=0.6)
    call = CallSettings(kind=kind, duration=1e-3, frequency_end=20e3)
    head = EarSettings(beam_radius=0.0)
    heard, lag = analysed_ears(head, call, spectrogram)
    delay = sweep_delay(call, heard.frequency)
    echo = np.zeros(echo_samples(spectrogram, 343.0, float(delay.max())))
    waveform = call_waveform(call, spectrogram.sampling_rate)
    echo[2000 : 2000 + len(waveform)] = waveform
    frequency = np.fft.rfftfreq(len(echo), 1 / spectrogram.sampling_rate)
    fine = ear_tables(head, np.maximum(frequency, 1.0) + 1e-6 * np.arange(len(frequency)))
    row, column = 40, 95
    gain = fine.ears[0, :, row, column].astype(float)
    # The beam of no radius fades towards the back and sounds alike at all frequencies.
    both = np.stack((echo, np.fft.irfft(np.fft.rfft(echo) * gain, len(echo))))
    power = dechirped_spectrogram(both, spectrogram, 343.0, delay) ** 2  # (2, R, F)
    expected = np.sqrt(power[1].sum(axis=0) / power[0].sum(axis=0))
    found = heard.ears[0, :, row, column]
    raw = np.interp(heard.frequency, frequency, gain)
    time = 2.0 * range_axis(spectrogram, 343.0) / 343.0 - 2000.0 / spectrogram.sampling_rate
    late = time @ power[1] / power[1].sum(axis=0)
    np.testing.assert_allclose(found, expected, atol=0.0015)
    assert np.abs(raw - expected).max() > 0.05
    np.testing.assert_allclose(lag[0, :, row, column], late, atol=2e-6)
    assert np.abs(late).max() > 20e-6


def line(count):
    return [(0.0, 0.03 * (n - (count - 1) / 2), 0.0) for n in range(count)]


@pytest.mark.parametrize("count", [1, 2, 8, 32])
@pytest.mark.parametrize("directivity", ["ear", "omnidirectional", "piston"])
def test_any_number_of_receivers(count, directivity):
    head = EarSettings(receivers=line(count), directivity=directivity)
    ears = ear_tables(head, FREQUENCY)
    assert len(receiver_places(head)) == count
    assert ears.ears.shape == (count, 4, 91, 181)
    np.testing.assert_allclose(ears.positions, line(count))
    assert ears.alike == (directivity != "ear" or count == 1)
    np.testing.assert_allclose(
        ear_gain(ears, count - 1, direction(20, 10)), ears.ears[-1, :, 50, 100][None], rtol=1e-4
    )


def test_a_piston_receiver_is_a_piston_of_its_radius():
    head = EarSettings(directivity="piston", piston_radius=0.004, beam_radius=0.004)
    ears = ear_tables(head, FREQUENCY)
    np.testing.assert_array_equal(ears.ears[0], ears.beam)
    wider = ear_tables(head.model_copy(update={"piston_radius": 0.002}), FREQUENCY)
    assert (wider.ears >= ears.ears - 1e-6).mean() > 0.99


@pytest.fixture
def file(tmp_path):
    write_sofa(tmp_path / "a.sofa", pair())
    return tmp_path / "a.sofa"


def measured(path, **changes):
    return EarSettings(directivity="file", file=path, **changes)


def test_a_file_gives_ears_beam_and_places(file):
    ears, known = ear_tables(measured(file), [30e3, 50e3]), pair()
    np.testing.assert_allclose(ears.positions, PLACES)
    for n, (azimuth, elevation) in enumerate((a, e) for a in AZIMUTH for e in ELEVATION):
        towards = direction(azimuth, elevation)
        for side in (0, 1):
            np.testing.assert_allclose(
                ear_gain(ears, side, towards)[0], known.gains[side, n, :2], atol=1e-5
            )
        np.testing.assert_allclose(beam_gain(ears, towards)[0], known.beam[n, :2], atol=1e-5)


def test_frequencies_outside_of_the_file_are_the_nearest(file):
    ears = ear_tables(measured(file), [1e3, 30e3, 80e3, 150e3])
    np.testing.assert_array_equal(ears.ears[:, 0], ears.ears[:, 1])
    np.testing.assert_array_equal(ears.ears[:, 3], ears.ears[:, 2])


def test_a_file_of_another_band_than_the_spectrograms_is_refused(file):
    high = SpectrogramSettings(sampling_rate=1e6, frequency_min=150e3, frequency_max=250e3)
    with pytest.raises(InputError, match=r"a\.sofa: is measured from .* Hz, and the spectrograms"):
        analysed_ears(measured(file), CallSettings(), high)


def test_behind_the_measured_half_nothing_is_heard(file):
    ears = ear_tables(measured(file), [50e3])
    assert ear_gain(ears, 0, direction(90, 0))[0] > 0.1
    assert ear_gain(ears, 0, direction(120, 0))[0] == 0.0


@pytest.mark.filterwarnings("ignore")
def test_sofar_and_both_mat_layouts_give_the_same_tables(tmp_path):
    from tests.head.directivity.sofa_files import written

    paths = [
        written(tmp_path / "a.sofa", "SimpleFreeFieldHRTF"),
        written(tmp_path / "b.sofa", "GeneralTF"),
        write_v5(tmp_path / "a.mat", sononerf_fields()),
        write_v73(tmp_path / "b.mat", sononerf_fields()),
        write_v5(tmp_path / "c.mat", batslam_fields()),
        write_v73(tmp_path / "d.mat", batslam_fields()),
    ]
    tables = [ear_tables(measured(path), [25e3, 40e3, 61e3]).ears for path in paths]
    for table in tables[1:]:
        np.testing.assert_allclose(table, tables[0], atol=1e-5)


def test_places_of_settings_count_before_those_of_the_file(file, tmp_path):
    there = ear_tables(measured(file, receivers=[(0, 0.1, 0), (0, -0.1, 0)]), [50e3])
    np.testing.assert_allclose(there.positions[:, 1], [0.1, -0.1])
    without = write_v5(tmp_path / "a.mat", batslam_fields())
    np.testing.assert_allclose(
        ear_tables(measured(without), [50e3]).positions, ear_tables(EarSettings(), [50e3]).positions
    )


def test_numbers_of_receivers_must_fit(file):
    with pytest.raises(SettingsError, match=r"gives 3 places, but .*a\.sofa holds 2 receivers"):
        ear_tables(measured(file, receivers=line(3)), [50e3])
    with pytest.raises(InputError, match="no such file"):
        ear_tables(measured(file.with_name("b.sofa")), [50e3])


def ring(*angles_deg):
    """Directions in the horizontal plane, (1, A, 3)."""
    angle = np.radians(angles_deg)
    return np.stack([np.cos(angle), np.sin(angle), np.zeros_like(angle)], axis=-1)[None]


@pytest.mark.parametrize(
    ("ka", "degrees", "expected"),
    # 2 J1(x) / x at x = ka sin(angle): tables of Bessel functions.
    [(2.0, 90.0, 0.5767248), (2.0, 30.0, 2 * 0.4400506), (5.0, 90.0, 2 * 0.3275791 / 5)],
)
def test_a_piston_in_a_baffle(ka, degrees, expected):
    frequency = np.array([40e3])
    radius = ka * SPEED / (2 * np.pi * 40e3)
    gain = piston(ring(degrees), radius, frequency)[0, 0, 0]
    fade = (1 + np.cos(np.radians(degrees))) / 2
    assert gain == pytest.approx(fade * expected, rel=1e-5)


def test_a_piston_is_whole_ahead_silent_behind_and_alike_without_a_radius():
    frequency = np.array([20e3, 80e3])
    np.testing.assert_allclose(piston(ring(0.0, 180.0), 0.003, frequency)[:, 0], [[1, 0], [1, 0]])
    assert (piston(ring(0.0, 90.0, 180.0), 0.0, frequency) == 1.0).all()


@pytest.mark.parametrize(("side", "best"), [(1.0, 25.0), (0.0, 0.0), (-1.0, -25.0)])
def test_an_ear_hears_best_on_its_side(side, best):
    angles = np.arange(-180.0, 180.0, 5.0)
    head = EarSettings(elevation_deg=0.0)
    gain = ear(ring(*angles), side, head, np.array([20e3]))
    assert angles[gain[0, 0].argmax()] == best
