# SPDX-License-Identifier: MIT
"""Range limits that are left out follow from the echoes; those that are set stay."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from sononerf.errors import InputError
from sononerf.head.call import call_waveform, emit
from sononerf.head.ears import beam_gain, ear_gain, ear_tables
from sononerf.head.front_end import frequency_axis
from sononerf.head.head import Head
from sononerf.recordings.ranges import calibrate_recording
from sononerf.run.import_recordings import plan_import
from sononerf.settings.schema import CallSettings, EarSettings, SpectrogramSettings
from sononerf.settings.sections import ReferenceSettings
from tests.recordings.recorded import SETTINGS, arrays, waveforms


def limits(tmp_path, *overrides, **changes):
    np.savez(tmp_path / "a.npz", **arrays(**changes))
    found = plan_import(
        "numpy", tmp_path / "a.npz", tmp_path / "s", overrides=[*SETTINGS, *overrides]
    )
    spectrogram = found.settings.spectrogram
    assert len(found.head.range) > 10
    return spectrogram.range_min, spectrogram.range_max


def test_they_hold_the_echoes_and_little_more(tmp_path):
    low, high = limits(tmp_path, waveform=waveforms(noise=1e-4))
    # The point is 0.36 to 0.44 m from the poses.
    assert 0.25 < low < 0.36
    assert 0.44 < high < 0.62


def test_what_is_set_stays(tmp_path):
    low, high = limits(tmp_path, "spectrogram.range_min=0.31", waveform=waveforms(noise=1e-4))
    assert low == 0.31
    assert high < 0.62
    both = limits(tmp_path, "spectrogram.range_min=0.31", "spectrogram.range_max=0.5")
    assert both == (0.31, 0.5)


def test_the_call_itself_is_left_out(tmp_path):
    waves = waveforms(noise=1e-4)
    waves[:, :, :20] += 50.0  # direct sound, far louder than echoes
    assert limits(tmp_path, waveform=waves)[0] > 0.06


def test_a_late_beginning_moves_the_first_range(tmp_path):
    waves = waveforms(noise=1e-4)
    start = 500 / 250_000  # 0.343 m: the first echoes are cut off
    low, _ = limits(tmp_path, waveform=waves[:, :, 500:], start=start)
    assert low == pytest.approx(0.343, abs=0.02)


RATE, SPEED = 1e6, 343.0
ANALYSIS = SpectrogramSettings(frequency_min=30e3, frequency_max=90e3)
EARS = ear_tables(EarSettings(notch_depth=0.0), frequency_axis(ANALYSIS))
TARGET = ReferenceSettings(file=Path("ball.wav"), radius=0.05, distance=0.4)
CALLS = [
    CallSettings(),
    CallSettings(kind="linear", duration=3e-4, frequency_start=100e3, frequency_end=25e3),
]


def echo_of(call, gain=(1.0, 1.0), offset=0.0, samples=6000):
    """Receivers of some gain hear a sphere straight ahead, too far off by an offset."""
    centre = EARS.emitter + np.array([TARGET.distance + TARGET.radius, 0, 0])
    out = np.linalg.norm(centre - EARS.emitter)
    responses = np.zeros((2, samples))
    frequency = np.fft.rfftfreq(samples, 1 / RATE)
    for ear in range(2):
        way = centre - EARS.positions[ear]
        back = np.linalg.norm(way)
        path = out + back - 2 * TARGET.radius + 2 * offset
        level = (
            beam_gain(EARS, np.array([[1.0, 0, 0]]))[0] * ear_gain(EARS, ear, way[None] / back)[0]
        )
        loudness = np.interp(frequency, EARS.frequency, level)
        spectrum = TARGET.radius / 2 / (out * back) / gain[ear] * loudness
        phase = np.exp(-2j * np.pi * frequency * path / SPEED)
        responses[ear] = np.fft.irfft(spectrum * phase, samples)
    return emit(responses, call_waveform(call, RATE))[:, :samples]


class Still(Head):
    """A head in air that absorbs nothing."""

    def absorption(self, frequency):
        return np.zeros(len(frequency))


def calibration(call, echo):
    return calibrate_recording(
        echo, TARGET, Still(ears=EarSettings(notch_depth=0.0), call=call, spectrogram=ANALYSIS)
    )


@pytest.mark.parametrize("call", CALLS, ids=["impulse", "sweep"])
def test_gain_and_offset_are_found(call):
    found = calibration(call, echo_of(call, gain=(2.0, 0.5), offset=0.007))
    np.testing.assert_allclose(20 * np.log10(found.gain), [6.02, -6.02], atol=0.3)
    assert found.range_offset == pytest.approx(-0.007, abs=3e-4)


def test_no_echo_is_told():
    with pytest.raises(InputError, match=r"ball\.wav: no echo of the reference target within 25 %"):
        calibration(CALLS[0], np.zeros((2, 6000)))
    with pytest.raises(InputError, match=r"import\.reference: the echo has 500 samples"):
        calibration(CALLS[0], np.zeros((2, 500)))
