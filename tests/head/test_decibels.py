# SPDX-License-Identifier: MIT
"""Noise makes a cell active as rarely as is said."""

from __future__ import annotations

import numpy as np
import pytest

from sononerf.head.decibels import (
    ACTIVE_DB,
    EXCEEDED,
    active_level,
    compress,
    expand,
    mae_all_and_active,
)


def test_noise_makes_one_cell_in_a_thousand_active():
    rng = np.random.default_rng(0)
    rms = np.array([[30.0], [50.0]])  # far above the reference, two ears, one frequency
    parts = rng.standard_normal((2, 2, 400_000)) * np.sqrt(0.5)
    magnitude = rms * np.hypot(*parts)  # Rayleigh's distribution
    active = compress(magnitude, 1.0) >= active_level(rms, 1.0)[:, 0]
    assert 0.8 * EXCEEDED < active.mean() < 1.2 * EXCEEDED


def test_without_noise_or_with_little_of_it_three_decibels_are_active():
    assert active_level(None, 1.0) == ACTIVE_DB
    assert (active_level(np.full((2, 3), 1e-6), 1.0) == ACTIVE_DB).all()


def test_levels_are_expanded_to_what_was_compressed():
    magnitude = np.array([[0.0, 1e-3], [0.5, 40.0]])
    np.testing.assert_allclose(expand(compress(magnitude, 0.2), 0.2), magnitude, rtol=1e-9)
    assert compress(9 * 0.2, 0.2) == 20.0
    with pytest.raises(ValueError, match="reference is 0, expected above 0"):
        compress(magnitude, 0)


def test_a_cell_at_the_active_level_is_active():
    heard, predicted = np.zeros((1, 1, 1, 2)), np.array([[[[ACTIVE_DB, 1.0]]]])
    for pair in ((heard, predicted), (predicted, heard)):
        assert mae_all_and_active(*pair, ACTIVE_DB) == ((ACTIVE_DB + 1.0) / 2, ACTIVE_DB)
