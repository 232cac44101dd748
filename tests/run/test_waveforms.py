# SPDX-License-Identifier: MIT
"""A simulated ensemble, written as recordings and imported, is the same ensemble."""

from __future__ import annotations

import numpy as np
import pytest

from sononerf.errors import InputError, SettingsError
from sononerf.head.decibels import compress
from sononerf.run.import_recordings import import_recordings
from sononerf.run.simulate import simulate
from sononerf.run.waveforms import write_waveforms

SWEEP = {"kind": "linear", "duration": 3e-4, "frequency_start": 100e3, "frequency_end": 20e3}


def test_a_round_trip_through_wav_and_csv(tiny, tmp_path):
    settings = tiny(
        data={"store": None},
        call=SWEEP,
        noise={"snr_db": 40.0},
        spectrogram={"frequency_min": 20e3},
        simulation={"engine": "rays"},
    )
    direct = simulate(settings, output=tmp_path / "direct", workers=1)
    written = write_waveforms(settings, tmp_path / "wav")
    assert [path.name for path in written] == ["poses.csv", "import.yaml", "ping_0000.wav"]
    back, _ = import_recordings("recordings", tmp_path / "wav", tmp_path / "back")
    np.testing.assert_allclose(back.positions, direct.positions, atol=1e-12)
    np.testing.assert_allclose(back.rotations, direct.rotations, atol=1e-12)
    np.testing.assert_array_equal(back.split, direct.split)
    np.testing.assert_allclose(back.range, direct.range, rtol=1e-12)
    np.testing.assert_allclose(back.frequency, direct.frequency)
    reference = direct.attributes["reference"]
    assert back.attributes["reference"] == pytest.approx(reference, rel=1e-4)
    for index in range(len(direct)):
        one, two = (compress(store.read_pose(index), reference) for store in (direct, back))
        active = (one >= 3) | (two >= 3)
        assert active.any()
        assert np.abs(one - two)[active].max() < 1.0  # dB
    known = ("air", "ears", "call", "spectrogram")
    assert all(
        back.attributes["settings"][name] == direct.attributes["settings"][name] for name in known
    )


def test_a_folder_with_files_is_left_alone(tiny, tmp_path):
    (tmp_path / "note.txt").write_text("mine")
    with pytest.raises(InputError, match="is not empty"):
        write_waveforms(tiny(), tmp_path)


def test_a_rate_that_wav_cannot_hold_is_told(tiny, tmp_path):
    settings = tiny(spectrogram={"sampling_rate": 1000000.5})
    with pytest.raises(SettingsError, match="a WAV file cannot hold"):
        write_waveforms(settings, tmp_path / "w")
