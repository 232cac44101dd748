# SPDX-License-Identifier: MIT
"""Offsets, background and a reference target change the echoes as they should."""

from __future__ import annotations

import numpy as np
import pytest

from sononerf.errors import InputError
from sononerf.head.call import call_waveform, emit
from sononerf.run.import_recordings import plan_import, spectrogram_of
from tests.recordings.recorded import RATE, SETTINGS, arrays, waveforms

LIMITS = ("spectrogram.range_min=0.3", "spectrogram.range_max=0.55")


@pytest.fixture
def recorded(tmp_path):
    def read(*overrides, **changes):
        np.savez(tmp_path / "a.npz", **arrays(**changes))
        given = [*SETTINGS, *LIMITS, *overrides]
        return plan_import("numpy", tmp_path / "a.npz", tmp_path / "s", overrides=given)

    return read


def other(path, waveform):
    np.savez(path, waveform=waveform, sampling_rate=float(RATE))


def test_a_start_between_samples_is_taken_off(recorded):
    whole = recorded()
    spectrum = np.fft.rfft(waveforms(), axis=-1)
    turn = np.exp(-2j * np.pi * np.fft.rfftfreq(1600) * 17.3)
    late = np.fft.irfft(spectrum * turn, 1600, axis=-1)
    moved = recorded(waveform=late, start=-17.3 / RATE)
    for ping in range(3):
        a, b = spectrogram_of(whole, ping), spectrogram_of(moved, ping)
        np.testing.assert_allclose(a, b, atol=1e-3 * a.max())
    offset = recorded(f"import.time_offset={17.3 / RATE}", waveform=late)
    np.testing.assert_allclose(spectrogram_of(offset, 1), spectrogram_of(moved, 1), atol=1e-6)


def test_a_range_offset_moves_echoes_farther(recorded):
    step = 343.0 / 2 / RATE
    near, far = (
        recorded("spectrogram.hop=1", f"import.range_offset={offset}")
        for offset in (0.0, 20 * step)
    )
    a, b = spectrogram_of(near, 0), spectrogram_of(far, 0)
    np.testing.assert_allclose(a[:, :-20], b[:, 20:], atol=1e-3 * a.max())


def test_a_background_is_taken_off(recorded, tmp_path):
    wall = waveforms(count=24, gain=2.0)[11]
    other(tmp_path / "empty.npz", wall)
    clean = recorded()
    found = recorded("import.background=empty.npz", waveform=waveforms() + wall)
    assert found.calibration["background"] == "empty.npz"
    np.testing.assert_allclose(spectrogram_of(clean, 2), spectrogram_of(found, 2), atol=1e-6)


def test_a_reference_target_sets_level_and_range(recorded, tmp_path):
    # A sphere of 5 cm at 0.4 m ahead, heard 6 dB too faint in receiver 1, and 8 mm too far off.
    ahead, ears = 0.45, recorded().head.gains
    back = np.linalg.norm(ears.emitter + np.array([ahead, 0, 0]) - ears.positions, axis=1)
    path = ahead + back - 0.1 + 2 * 0.008
    frequency = np.fft.rfftfreq(1600, 1 / RATE)
    level = 0.025 / (ahead * back) * [1.0, 0.5]
    turned = np.exp(-2j * np.pi * frequency * path[:, None] / 343.0)
    call = recorded().settings.call
    echo = emit(np.fft.irfft(level[:, None] * turned, 1600), call_waveform(call, RATE))[:, :1600]
    other(tmp_path / "ball.npz", echo)
    found = recorded("import.reference={file: ball.npz, radius: 0.05, distance: 0.4}")
    applied = found.calibration["reference"]
    assert applied["gain_db"][1] - applied["gain_db"][0] == pytest.approx(6.02, abs=0.3)
    assert applied["range_offset_m"] == pytest.approx(-0.008, abs=1.5e-3)


def test_other_recordings_must_fit(recorded, tmp_path):
    other(tmp_path / "empty.npz", waveforms()[0, :1])
    with pytest.raises(InputError, match=r"empty\.npz: 1 channels at 250000 Hz"):
        recorded("import.background=empty.npz")
    with pytest.raises(InputError, match=r"none\.npz: no such file"):
        recorded("import.background=none.npz")
