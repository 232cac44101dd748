# SPDX-License-Identifier: MIT
"""Recordings and settings complete one another, and contradictions are told."""

from __future__ import annotations

import numpy as np
import pytest

from sononerf.echoes.store import EnsembleStore
from sononerf.errors import InputError, SettingsError
from sononerf.head.call import call_waveform
from sononerf.recordings.recording import wav_bytes
from sononerf.run.build import with_store
from sononerf.run.import_recordings import import_hash, plan_import, spectrogram_of, write_import
from sononerf.settings.loading import validate_settings
from sononerf.settings.schema import CallSettings
from tests.recordings.recorded import CALL, EARS, RATE, SETTINGS, arrays, waveforms


@pytest.fixture
def recorded(tmp_path):
    """Understand arrays with some changes and settings."""

    def read(*overrides, settings=SETTINGS, settings_file=None, **changes):
        np.savez(tmp_path / "a.npz", **arrays(**changes))
        return plan_import(
            "numpy",
            tmp_path / "a.npz",
            tmp_path / "store",
            settings_file=settings_file,
            overrides=[*settings, *overrides],
        )

    return read


def test_the_rate_and_the_band_come_from_recording_and_call(recorded):
    found = recorded(settings=SETTINGS[:2])
    spectrogram = found.settings.spectrogram
    assert (spectrogram.sampling_rate, spectrogram.frequency_min, spectrogram.frequency_max) == (
        RATE,
        20e3,
        80e3,
    )
    # A point echo is shortest through this window, and a sixteenth of it is a step.
    assert (spectrogram.window, spectrogram.hop, spectrogram.fft) == (42, 2, 128)
    assert found.head.speed_of_sound == 343.0


@pytest.mark.parametrize(
    ("rate", "low", "high", "window"), [(450e3, 20e3, 80e3, 32), (100e3, 10e3, 30e3, 16)]
)
def test_another_band_runs_with_no_setting_but_the_band(recorded, rate, low, high, window):
    given = (f"spectrogram.frequency_min={low}", f"spectrogram.frequency_max={high}")
    found = recorded(*given, settings=SETTINGS[:1], sampling_rate=rate)
    assert found.settings.spectrogram.window == window
    assert found.head.samples <= 1600


def test_settings_lie_beside_the_recordings(recorded, tmp_path):
    (tmp_path / "import.yaml").write_text("import: {heldout: 7}\nair: {temperature_c: 20}\n")
    found = recorded()
    assert np.bincount(found.split).tolist() == [16, 1, 7]
    assert found.head.speed_of_sound == pytest.approx(343.2)
    (tmp_path / "other.yaml").write_text("import: {heldout: 5}\n")
    found = recorded("import.validation=2", settings_file=tmp_path / "other.yaml")
    assert np.bincount(found.split).tolist() == [17, 2, 5]


def test_files_of_the_settings_lie_beside_them(recorded, tmp_path):
    samples = call_waveform(CallSettings(**CALL), RATE)
    (tmp_path / "call.wav").write_bytes(wav_bytes(samples[None], RATE))
    (tmp_path / "import.yaml").write_text("call: {kind: file, file: call.wav}\n")
    found = recorded(settings=(SETTINGS[0], *SETTINGS[2:]))
    assert found.settings.call.file == tmp_path / "call.wav"
    write_import(found, tmp_path / "store")
    (tmp_path / "call.wav").unlink()
    known = with_store(validate_settings({"data": {"store": str(tmp_path / "store")}}, "test"))
    assert known.call.file.parent == tmp_path / "store" / "attached"
    assert EnsembleStore.open(tmp_path / "store").damaged() == []


def test_clipped_pings_are_left_out_and_counted(recorded):
    waves = waveforms()
    waves[[3, 8]] *= 3
    top = 0.7 * np.abs(waves[[3, 8]]).max()
    waves = np.clip(waves, -top, top)
    found = recorded(waveform=waves)
    assert found.clipped == 2
    assert set(range(24)) - set(found.pings.tolist()) == {3, 8}
    assert recorded("import.reject_clipped=false", waveform=waves).clipped == 0


def test_channels_are_chosen_and_counted(recorded):
    waves = np.concatenate([waveforms(), waveforms()], axis=1)
    with pytest.raises(InputError, match="4 channels, and the settings describe 2 receivers"):
        recorded(waveform=waves)
    assert len(recorded("import.channels=[0, 1]", waveform=waves).pings) == 24
    with pytest.raises(InputError, match=r"no channel 9; the recordings have 0 to 3"):
        recorded("import.channels=[0, 9]", waveform=waves)
    with pytest.raises(InputError, match="1 channels, and the settings describe 2 receivers"):
        recorded(waveform=waveforms()[:, :1])
    alone = {**EARS, "receivers": [[0, 0, 0]]}
    one = recorded(f"ears={alone}", waveform=waveforms(receivers=[[0, 0, 0]]))
    assert one.cutter.echo(0, 100).shape == (1, 100)


@pytest.mark.parametrize(
    ("overrides", "words"),
    [
        (["fit.epochs=3"], "fit: no section of an import; known: import, air"),
        (["spectrogram.sampling_rate=1e6"], "the recordings have 250000 Hz; leave it out"),
        (["import.lengths=mm"], "import.lengths: unknown key; did you mean length?"),
        (["ears.left=1"], "ears.left"),
        (["spectrogram.frequency_max=200e3"], "half the sampling_rate"),
    ],
)
def test_wrong_settings_are_told(recorded, overrides, words):
    with pytest.raises(SettingsError) as caught:
        recorded(*overrides)
    assert words in str(caught.value)


def test_wrong_calls_are_told(tmp_path):
    np.savez(tmp_path / "a.npz", **arrays())
    for form, source, error, words in (
        ("wave", "a.npz", SettingsError, "unknown format 'wave'; known: recordings, numpy"),
        ("numpy", "b.npz", InputError, "no such file or folder"),
        ("numpy", ".", InputError, "is a folder; the format numpy is one file"),
    ):
        with pytest.raises(error, match=words):
            plan_import(form, tmp_path / source, tmp_path / "store")


def test_all_clipped_or_nan_or_short_is_told(recorded):
    waves = waveforms()
    with pytest.raises(InputError, match="all 24 pings are clipped"):
        recorded(waveform=np.clip(waves, -0.3 * abs(waves[0]).max(), 0.3 * abs(waves[0]).max()))
    bad = waves.copy()
    bad[5, 0, 3] = np.nan
    with pytest.raises(InputError, match="ping 5: holds samples that are NaN"):
        recorded(waveform=bad)
    with pytest.raises(InputError, match=r"the recordings end 0\.99"):
        recorded("spectrogram.range_max=3.0")
    with pytest.raises(InputError, match="the time of the emission lies after the end"):
        recorded("import.time_offset=1.0")
    with pytest.raises(InputError, match=r"begins after spectrogram\.range_min"):
        recorded("spectrogram.range_min=0.2", start=3e-3)
    assert CALL["kind"] == "linear"


def test_pulse_compression_gives_echoes_of_an_impulse(recorded):
    plain, found = recorded(), recorded("import.compress=true")
    assert (plain.settings.call.kind, found.settings.call.kind) == ("linear", "impulse")
    assert found.calibration["compressed"]["kind"] == "linear"
    wide, narrow = (
        (power > 0.25 * power.max()).sum()
        for power in (np.square(spectrogram_of(each, 3)[0]).mean(axis=1) for each in (plain, found))
    )
    assert narrow < 0.6 * wide
    assert import_hash(plain) != import_hash(found)
