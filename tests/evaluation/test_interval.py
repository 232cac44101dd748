# SPDX-License-Identifier: MIT
from __future__ import annotations

import numpy as np
import pytest

from sononerf.evaluation.traced import covered, interval_db, learn_interval
from sononerf.head.decibels import RANGE_DB


def drawn(seed, poses=12):
    """Levels, and predictions whose error grows with the level and with the frequency."""
    rng = np.random.default_rng(seed)
    predicted = rng.uniform(0.0, 50.0, (poses, 2, 40, 24))
    spread = (0.5 + predicted / 10.0) * np.linspace(0.5, 2.0, 24)
    return predicted + spread * rng.standard_normal(predicted.shape), predicted


def test_nine_tenths_of_new_cells_lie_within_the_interval_at_each_level_and_frequency():
    half = learn_interval(*drawn(0), 3.0)
    measured, predicted = drawn(1)
    found = interval_db(predicted, half)
    assert covered(measured, predicted, found, 3.0) == pytest.approx(0.9, abs=0.02)
    loud = predicted > 30.0
    within = np.abs(measured - predicted) <= found
    for part in (loud[..., :8], loud[..., 16:]):
        cells = within[..., :8] if part is loud[..., :8] else within[..., 16:]
        assert cells[part].mean() == pytest.approx(0.9, abs=0.06)
    assert found[..., -1][loud[..., -1]].mean() > 2.0 * found[..., 0][loud[..., 0]].mean()


def test_levels_that_were_never_predicted_are_as_uncertain_as_lower_ones():
    measured, predicted = drawn(0)
    low = np.minimum(predicted, 20.0)
    half = learn_interval(np.minimum(measured, 20.0), low, 3.0)
    assert (interval_db(np.full((1, 24), 55.0), half) == half[3]).all()


def test_lower_levels_that_were_never_predicted_are_as_uncertain_as_higher_ones():
    measured, predicted = drawn(0)
    half = learn_interval(measured + 24.0, predicted + 24.0, 3.0)
    assert (interval_db(np.full((1, 24), 4.0), half) == half[4]).all()
    assert (half[4] > 0.0).all()


def test_where_nothing_was_heard_a_level_is_not_known():
    silent = np.zeros((2, 1, 5, 3))
    assert (learn_interval(silent, silent, 3.0) == RANGE_DB).all()
    assert covered(silent, silent, silent, 3.0) is None
