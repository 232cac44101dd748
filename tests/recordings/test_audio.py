# SPDX-License-Identifier: MIT
"""Sound files come in as they are; broken ones are told in one line."""

from __future__ import annotations

import h5py
import numpy as np
import pytest
import soundfile
from scipy.io import wavfile

from sononerf.errors import InputError
from sononerf.geometry.poses import Poses
from sononerf.recordings.pose_tables import to_poses
from sononerf.recordings.readers import read_folder, read_numpy
from sononerf.recordings.recording import as_float, pose_table, read_audio, wav_bytes
from sononerf.settings.sections import ImportSettings

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
    wav = read_audio(path)
    assert (wav.rate, wav.samples.shape) == (RATE, (400, 2))
    np.testing.assert_allclose(as_float(wav.samples.T), tone, atol=accuracy)


@pytest.mark.parametrize(("suffix", "kind"), [(".wav", "PCM_24"), (".flac", "PCM_16")])
def test_24_bits_and_flac(tmp_path, tone, suffix, kind):
    path = tmp_path / f"a{suffix}"
    soundfile.write(path, tone.T, RATE, subtype=kind)
    wav = read_audio(path)
    assert (wav.rate, wav.samples.dtype.kind) == (RATE, "i")
    np.testing.assert_allclose(as_float(wav.samples.T), tone, atol=4e-5)


def test_one_channel_has_a_channel_axis(tmp_path, tone):
    path = tmp_path / "a.wav"
    wavfile.write(path, RATE, tone[0].astype("float32"))
    assert read_audio(path).samples.shape == (400, 1)


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


COUNT, RECEIVERS, SAMPLES = 4, 2, 50
PLAIN = ImportSettings()


def arrays(**changes):
    rng = np.random.default_rng(0)
    given = {
        "waveform": rng.standard_normal((COUNT, RECEIVERS, SAMPLES)),
        "sampling_rate": 1e5,
        "start": 1.25e-4,
        "position_mm": rng.standard_normal((COUNT, 3)),
        "euler_deg": np.zeros((COUNT, 3)),
        "split": np.array([0, 0, 1, 2]),
        **changes,
    }
    return {name: values for name, values in given.items() if values is not None}


def save(path, given):
    if path.suffix == ".npz":
        np.savez(path, **given)
    else:
        with h5py.File(path, "w") as file:
            for name, values in given.items():
                file[name] = values
    return path


@pytest.mark.parametrize("name", ["a.npz", "a.h5"])
def test_arrays_become_pings_and_poses(tmp_path, name):
    given = arrays()
    found = read_numpy(save(tmp_path / name, given), PLAIN)
    assert (len(found), found.sampling_rate) == (COUNT, 1e5)
    np.testing.assert_array_equal(found.read(2), given["waveform"][2])
    np.testing.assert_allclose(found.emission, -1.25e-4)
    poses = to_poses(found.columns, PLAIN)
    np.testing.assert_allclose(poses.positions, given["position_mm"] / 1000)
    np.testing.assert_allclose(poses.rotations, np.broadcast_to(np.eye(3), (COUNT, 3, 3)))
    assert found.columns.split().tolist() == [0, 0, 1, 2]


def test_one_receiver_needs_no_axis_and_a_turntable_no_orientation(tmp_path):
    angle = np.arange(COUNT) * 90.0
    given = arrays(
        waveform=np.zeros((COUNT, SAMPLES)),
        start=np.arange(COUNT) * 1e-5,
        position_mm=None,
        euler_deg=None,
        angle_deg=angle,
        height_mm=0 * angle,
    )
    settings = ImportSettings(turntable={"radius": 0.6})
    found = read_numpy(save(tmp_path / "a.npz", given), settings)
    assert found.read(0).shape == (1, SAMPLES)
    np.testing.assert_allclose(found.emission, -np.arange(COUNT) * 1e-5)
    away = np.linalg.norm(to_poses(found.columns, settings).positions, axis=1)
    np.testing.assert_allclose(away, 0.6)


@pytest.mark.parametrize("order", ["wxyz", "xyzw"])
def test_the_order_of_quaternions_is_stated(tmp_path, order):
    one = {"w": np.sqrt(0.5), "x": 0.0, "y": 0.0, "z": np.sqrt(0.5)}
    quaternion = np.tile([one[part] for part in order], (COUNT, 1))
    path = save(tmp_path / "a.npz", arrays(euler_deg=None, quaternion=quaternion))
    with pytest.raises(InputError, match=r"set import\.quaternion"):
        read_numpy(path, PLAIN)
    settings = ImportSettings(quaternion=order)
    poses = to_poses(read_numpy(path, settings).columns, settings)
    np.testing.assert_allclose(poses.rotations[0] @ [1, 0, 0], [0, 1, 0], atol=1e-12)


@pytest.mark.parametrize(
    ("changes", "words"),
    [
        ({"waveform": None}, "holds no array waveform; it holds euler_deg"),
        ({"waveform": np.zeros(5)}, "waveform has shape"),
        ({"sampling_rate": None}, "holds no sampling_rate"),
        ({"sampling_rate": -1.0}, "expected one number above 0"),
        ({"position_mm": np.zeros((3, 3)), "euler_deg": np.zeros((3, 3))}, "4 pings and 3 poses"),
        ({"position_mm": np.zeros((3, 3))}, "differ in length: position_mm 3, euler_deg 4"),
        ({"position_mm": np.zeros((4, 2))}, "position_mm has shape"),
        ({"position_mm": np.full((4, 3), np.nan)}, "not finite"),
        ({"position_mm": None, "position": np.zeros((4, 3))}, "column x has no unit"),
        ({"start": np.zeros(3)}, "start has 3 values, expected 1 or 4"),
        ({"speed": np.zeros(4)}, "unknown column 'speed'"),
    ],
)
def test_what_does_not_fit_is_told(tmp_path, changes, words):
    with pytest.raises(InputError) as caught:
        read_numpy(save(tmp_path / "a.npz", arrays(**changes)), PLAIN)
    assert words in str(caught.value)
    assert "\n" not in str(caught.value)
