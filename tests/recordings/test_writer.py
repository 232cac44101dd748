# SPDX-License-Identifier: MIT
"""What is written is what the reader reads."""

from __future__ import annotations

import numpy as np
import pytest

from sononerf.geometry.poses import sphere_poses
from sononerf.recordings.conventions import to_poses
from sononerf.recordings.folder import read_folder
from sononerf.recordings.writer import pose_table, wav_bytes
from sononerf.settings.import_schema import ImportSettings


def test_a_folder_comes_back(tmp_path):
    poses = sphere_poses(3, radius=0.4, aim_jitter=0.2, generator=np.random.default_rng(0))
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
