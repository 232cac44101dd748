# SPDX-License-Identifier: MIT
"""The noise of recordings is found before the first echoes, and cells below it do not count."""

from __future__ import annotations

import numpy as np
import pytest

from sononerf.echoes.detection import heard_again
from sononerf.echoes.echoes import Echoes
from sononerf.geometry.poses import Poses
from sononerf.head.decibels import ACTIVE_DB, active_level, compress
from sononerf.head.head import Head
from sononerf.settings.schema import SpectrogramSettings

HEAD = Head(analysis=SpectrogramSettings(range_min=0.2, range_max=0.4))
POSES = 40


def echoes(noise, calibrated=False, at=0.3):
    """Poses that hear a point amid noise of some strength per frequency."""
    rng = np.random.default_rng(0)
    places = rng.normal(size=(POSES, 3))
    places *= 0.3 / np.linalg.norm(places, axis=1, keepdims=True)
    echo = np.exp(-(((HEAD.range - at) / 0.004) ** 2))[:, None]
    shape = (POSES, 2, len(HEAD.range), len(HEAD.frequency))
    drawn = rng.standard_normal((2, *shape)) * noise / np.sqrt(2.0)
    heard = np.abs(echo + drawn[0] + 1j * drawn[1])
    return Echoes.from_arrays(heard, Poses.looking_at(places), HEAD, calibrated=calibrated)


def test_its_strength_is_found_per_frequency():
    strength = np.linspace(0.005, 0.02, len(HEAD.frequency))
    known = echoes(strength).store.attributes
    assert known["noise_floor_of"] == "noise before the first echoes"
    np.testing.assert_allclose(known["noise"], np.tile(strength, (2, 1)), rtol=0.15)


def test_the_floor_is_what_two_recordings_differ_by():
    """A second recording with other noise differs as much as the floor says."""
    found = echoes(0.01)
    test, reference = found.store.indices("test"), found.reference
    noise = np.asarray(found.store.attributes["noise"])
    first = np.stack([found.spectrogram(int(i)) for i in test])
    again = np.stack([heard_again(one, noise, 5) for one in first])
    error = np.abs(compress(first, reference) - compress(again, reference))
    louder = np.maximum(compress(first, reference), compress(again, reference))
    active = louder >= found.active_db
    known = found.store.attributes
    assert known["noise_floor_mae_db"] == pytest.approx(error.mean(), rel=0.1)
    assert known["noise_floor_mae_db_active"] == pytest.approx(error[active].mean(), rel=0.2)
    assert known["noise_floor_mae_db_active"] < 0.5 * known["noise_floor_mae_db"]


def test_cells_of_noise_are_not_active():
    found = echoes(0.01)
    silent = np.abs(HEAD.range - 0.3) > 0.05
    levels = np.stack([compress(found.spectrogram(i), found.reference) for i in range(POSES)])
    assert (levels >= ACTIVE_DB)[:, :, silent].mean() > 0.9  # noise is far above the reference
    assert (levels >= found.active_db)[:, :, silent].mean() < 0.005


def test_without_noise_all_is_as_before():
    quiet = echoes(0.0)
    assert quiet.active_db == pytest.approx(ACTIVE_DB)
    assert quiet.store.attributes["noise_floor_mae_db"] is None
    simulated = echoes(0.01, calibrated=True)
    assert simulated.active_db == ACTIVE_DB
    assert "noise" not in simulated.store.attributes
    assert active_level(None, 1.0) == ACTIVE_DB


def test_echoes_from_the_first_slice_on_tell_no_noise():
    early = echoes(0.01, at=HEAD.range[4])
    assert "noise" not in early.store.attributes
    assert early.active_db == ACTIVE_DB
