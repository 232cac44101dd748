# SPDX-License-Identifier: MIT
"""Reported decibels and noise floor are the same thing for all ensembles."""

from __future__ import annotations

import numpy as np
import pytest

from sononerf.echoes.sealing import seal
from sononerf.echoes.store import EnsembleStore
from sononerf.errors import NumericalError
from sononerf.head.decibels import compress


def store_of(path, levels):
    store = EnsembleStore.create(
        path,
        poses_positions=np.zeros((3, 3)),
        poses_rotations=np.stack([np.eye(3)] * 3),
        split=[0, 0, 2],
        range=[0.1, 0.2],
        frequency=[1e4, 2e4],
        attributes={"echo_hash": "x"},
        receivers=1,
    )
    for index, level in enumerate(levels):
        store.write_pose(index, np.full((1, 2, 2), level))
    return store


def test_decibels_start_60_db_below_the_loudest_training_pose(tmp_path):
    store = store_of(tmp_path / "s", [0.5, 2.0, 9.0])
    seal(store, {2: np.full((1, 2, 2), 4.5, np.float32)}, silent="nothing")
    known = EnsembleStore.open(tmp_path / "s").attributes
    assert known["reference"] == pytest.approx(2e-3)
    apart = compress(9.0, 2e-3) - compress(4.5, 2e-3)
    assert known["noise_floor_mae_db"] == pytest.approx(apart)
    assert known["noise_floor_mae_db_active"] == pytest.approx(apart)


def test_without_repeats_there_is_no_noise_floor(tmp_path):
    seal(store_of(tmp_path / "s", [1.0, 2.0, 3.0]), {}, silent="nothing")
    known = EnsembleStore.open(tmp_path / "s").attributes
    assert known["noise_floor_mae_db"] is known["noise_floor_mae_db_active"] is None


def test_silence_is_told(tmp_path):
    with pytest.raises(NumericalError, match="nothing was heard"):
        seal(store_of(tmp_path / "s", [0.0, 0.0, 3.0]), {}, silent="nothing was heard")
