# SPDX-License-Identifier: MIT


import os

import numpy as np
import pytest
import scipy.io.wavfile
import scipy.signal

from sononerf.errors import InputError
from sononerf.head.call import (
    call_content,
    call_waveform,
    covered,
    emit,
    has_ghosts,
    load_call,
    sweep_delay,
    sweep_rate,
)
from sononerf.head.head import Head
from sononerf.head.reception import effective_window
from sononerf.settings.schema import CallSettings, SpectrogramSettings

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


RATE = 500_000
SWEEP = CallSettings(
    kind="hyperbolic", duration=1e-3, frequency_start=110e3, frequency_end=30e3, taper=0.1
)


@pytest.fixture
def written(tmp_path):
    def write(samples, rate=RATE, name="call.wav"):
        scipy.io.wavfile.write(tmp_path / name, rate, np.asarray(samples))
        return CallSettings(kind="file", file=tmp_path / name)

    return write


def test_a_waveform_is_read_at_its_own_rate_and_at_another(written):
    waveform = call_waveform(SWEEP, RATE)
    call = written((20_000 * waveform).astype(np.int16))
    read = call_waveform(call, RATE)
    assert abs(read).max() == 1.0
    np.testing.assert_allclose(read, waveform / abs(waveform).max(), atol=1e-4)
    finer = call_waveform(call, 1e6)
    np.testing.assert_allclose(finer[::2], read, atol=5e-3)
    expected = call_waveform(SWEEP, 1e6)
    middle = slice(100, 900)
    assert abs(finer[middle] - expected[middle] / abs(waveform).max()).max() < 0.02


@pytest.mark.parametrize("kind", ["linear", "hyperbolic"])
@pytest.mark.parametrize("ends", [(110e3, 30e3), (30e3, 110e3)])
def test_delays_are_those_of_the_sweep_that_was_written(written, kind, ends):
    changes = {"kind": kind, "frequency_start": ends[0], "frequency_end": ends[1]}
    sweep = SWEEP.model_copy(update=changes)
    call = written(call_waveform(sweep, RATE).astype(np.float32))
    frequency = np.linspace(40e3, 92e3, 30)
    late = sweep_delay(call, frequency) - sweep_delay(sweep, frequency)
    assert abs(late).max() < 5e-6  # 0.9 mm
    middle = frequency[frequency < 85e3]
    np.testing.assert_allclose(sweep_rate(call, middle), sweep_rate(sweep, middle), rtol=0.15)
    ((low, high),) = load_call(call.file).bands
    assert low == pytest.approx(30e3, abs=8e3)
    assert high == pytest.approx(110e3, abs=8e3)
    assert covered(call, [20e3, 60e3, 125e3]).tolist() == [False, True, False]


def test_silence_before_the_call_counts_as_time(written):
    waveform = call_waveform(SWEEP, RATE)
    plain = written(waveform.astype(np.float32))
    later = written(np.pad(waveform, (250, 100)).astype(np.float32), name="later.wav")
    frequency = np.linspace(40e3, 92e3, 30)
    moved = sweep_delay(later, frequency) - sweep_delay(plain, frequency)
    np.testing.assert_allclose(moved, 500e-6, atol=4e-6)


def test_a_point_echo_of_a_file_is_that_of_its_sweep(written):
    call = written(call_waveform(SWEEP, 1e6).astype(np.float32), rate=1_000_000)
    spectrogram = SpectrogramSettings(frequency_min=45e3, frequency_max=85e3, window=160)
    assert has_ghosts(call, [50e3])
    found, expected = effective_window(call, spectrogram), effective_window(SWEEP, spectrogram)
    width = min(found.shape[1], expected.shape[1])
    assert found.shape[1] % 2 == expected.shape[1] % 2
    found, expected = (
        each[:, (each.shape[1] - width) // 2 :][:, :width] for each in (found, expected)
    )
    # A file's is not made symmetric, and its delays are estimates.
    assert abs(found - expected).max() < 0.2
    assert abs(found - expected).mean() < 0.03


def test_a_hash_is_of_what_a_file_holds(written):
    waveform = call_waveform(SWEEP, RATE).astype(np.float32)
    first, second = written(waveform), written(waveform, name="copy.wav")
    assert call_content(first) == call_content(second)
    assert call_content(written(0.5 * waveform, name="b.wav")) == call_content(first)  # its level
    assert call_content(written(waveform[:-9], name="c.wav")) != call_content(first)
    assert call_content(written(waveform, 400_000, name="d.wav")) != call_content(first)
    assert call_content(SWEEP) != call_content(SWEEP.model_copy(update={"taper": 0.3}))
    preset = CallSettings(preset="airsas")
    assert call_content(preset) == call_content(preset.model_copy(update={"preset": None}))


def test_a_file_that_changes_is_read_again(written):
    waveform = call_waveform(SWEEP, RATE).astype(np.float32)
    before = call_content(written(waveform))
    other = written(waveform[::-1])  # of the same size
    os.utime(other.file, ns=(1, 2))
    assert call_content(other) != before


@pytest.mark.parametrize(
    ("samples", "words"),
    [
        (np.ones((400, 2), dtype=np.int16), "2 channels, expected 1"),
        (np.zeros(400, dtype=np.int16), "is silent"),
        (np.full(400, 128, dtype=np.uint8), "is silent"),
        (np.full(400, np.nan, dtype=np.float32), "not finite"),
        (np.ones(RATE // 5, dtype=np.int16), "lasts 0.2 s, allowed is 0.1 s"),
        (np.ones(3, dtype=np.int16), "3 samples, expected 8 or more"),
    ],
)
def test_bad_files_are_refused_in_one_line(written, samples, words):
    call = written(samples)
    with pytest.raises(InputError, match=words) as caught:
        call_waveform(call, 1e6)
    assert str(caught.value).startswith(f"{call.file}: ")
    assert "\n" not in str(caught.value)


def test_a_call_outside_the_band_is_refused(written):
    call = written(call_waveform(SWEEP, RATE).astype(np.float32))
    spectrogram = SpectrogramSettings(frequency_min=150e3, frequency_max=200e3)
    with pytest.raises(InputError, match=r"holds sound at 2\d.\d to 1\d\d.\d kHz, nothing within"):
        Head(call=call, spectrogram=spectrogram)
