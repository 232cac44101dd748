# SPDX-License-Identifier: MIT
import os

import numpy as np
import pytest
import scipy.io.wavfile

from sononerf.errors import InputError
from sononerf.head.call import (
    call_content,
    call_waveform,
    covered,
    has_ghosts,
    sweep_delay,
    sweep_rate,
)
from sononerf.head.call_file import load_call
from sononerf.head.head import Head
from sononerf.head.reception import effective_window
from sononerf.settings.schema import CallSettings, SpectrogramSettings

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
    analysis = SpectrogramSettings(frequency_min=45e3, frequency_max=85e3, window=160)
    assert has_ghosts(call, [50e3])
    found, expected = effective_window(call, analysis), effective_window(SWEEP, analysis)
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
    analysis = SpectrogramSettings(frequency_min=150e3, frequency_max=200e3)
    with pytest.raises(InputError, match=r"holds sound at 2\d.\d to 1\d\d.\d kHz, nothing within"):
        Head(call=call, analysis=analysis)
