# SPDX-License-Identifier: MIT
"""Sound files come in as they are; broken ones are told in one line."""

from __future__ import annotations

import numpy as np
import pytest
import soundfile
from scipy.io import wavfile

from sononerf.geometry.poses import Poses
from sononerf.recordings.audio import as_float, pose_table, read_audio, wav_bytes
from sononerf.recordings.folder import read_folder
from sononerf.recordings.pose_tables import to_poses
from sononerf.settings.import_schema import ImportSettings

RATE = 250_000


@pytest.fixture
def tone():
    """Two channels of a tone at half of full scale."""
    time = np.arange(400) / RATE
    return 0.5 * np.stack([np.sin(2 * np.pi * 40e3 * time), np.cos(2 * np.pi * 30e3 * time)])


@pytest.mark.parametrize(
    ("dtype", "accuracy"), [("int16", 4e-5), ("int32", 1e-9), ("float32", 1e-7), ("uint8", 8e-3)]
)
def test_numbers_of_all_types_mean_the_same(tmp_path, tone, dtype, accuracy):
    path = tmp_path / "a.wav"
    whole = {"int16": 2.0**15, "int32": 2.0**31, "float32": 1.0, "uint8": 128.0}[dtype]
    numbers = tone * whole + (128.0 if dtype == "uint8" else 0.0)
    wavfile.write(path, RATE, numbers.T.astype(dtype))
    rate, samples = read_audio(path)
    assert (rate, samples.shape) == (RATE, (2, 400))
    np.testing.assert_allclose(as_float(samples), tone, atol=accuracy)


@pytest.mark.parametrize(("suffix", "kind"), [(".wav", "PCM_24"), (".flac", "PCM_16")])
def test_24_bits_and_flac(tmp_path, tone, suffix, kind):
    path = tmp_path / f"a{suffix}"
    soundfile.write(path, tone.T, RATE, subtype=kind)
    rate, samples = read_audio(path)
    assert (rate, samples.dtype.kind) == (RATE, "i")
    np.testing.assert_allclose(as_float(samples), tone, atol=4e-5)


def test_one_channel_has_a_channel_axis(tmp_path, tone):
    path = tmp_path / "a.wav"
    wavfile.write(path, RATE, tone[0].astype("float32"))
    assert read_audio(path)[1].shape == (1, 400)


def test_a_folder_comes_back(tmp_path):
    poses = Poses.sphere(3, radius=0.4, aim_jitter=0.2, generator=np.random.default_rng(0))
    waves = np.random.default_rng(1).standard_normal((3, 2, 70)).astype("float32")
    names = [f"{index}.wav" for index in range(3)]
    for name, wave in zip(names, waves, strict=True):
        (tmp_path / name).write_bytes(wav_bytes(wave, 1e6))
    split = np.array([0, 2, 1], dtype=np.int8)
    (tmp_path / "poses.csv").write_text(pose_table(poses, names, split), encoding="utf-8")
    found = read_folder(tmp_path, ImportSettings())
    back = to_poses(found.columns, ImportSettings())
    np.testing.assert_array_equal(found.read(1), waves[1])
    np.testing.assert_allclose(back.positions, poses.positions, rtol=0, atol=0)
    np.testing.assert_allclose(back.rotations, poses.rotations, atol=1e-12)
    assert found.columns.split().tolist() == [0, 2, 1]


def test_a_rate_of_a_fraction_is_refused():
    with pytest.raises(ValueError, match="cannot hold"):
        wav_bytes(np.zeros((1, 5)), 44100.5)
