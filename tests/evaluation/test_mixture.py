# SPDX-License-Identifier: MIT
"""Two predictions are combined so that the error on other poses is least."""

from __future__ import annotations

import numpy as np
import pytest

from sononerf.evaluation.traced import gain_db, mix, regress_weight

SHAPE = (3, 2, 20, 5)  # poses, ears, ranges, frequencies
OFFSETS = np.array([[-3.0, -0.25, 0.0, 1.5, 4.0], [1.0, 2.0, -1.0, 0.5, -4.0]])  # per ear


def levels(seed=0, low=25, high=60):
    """Levels that are whole quarters of a decibel."""
    return np.random.default_rng(seed).integers(4 * low, 4 * high, SHAPE) / 4


def test_a_known_gain_is_found_exactly():
    traced = levels()
    np.testing.assert_array_equal(gain_db(traced + OFFSETS[:, None], traced), OFFSETS)


@pytest.mark.parametrize("quiet", ["measured", "traced"])
def test_quiet_cells_do_not_count_for_the_gain(quiet):
    traced = levels()
    measured = traced + OFFSETS[:, None]
    (measured if quiet == "measured" else traced)[:, :, 7:] = 1
    np.testing.assert_array_equal(gain_db(measured, traced), OFFSETS)


def test_a_frequency_without_loud_cells_has_no_gain():
    traced = levels()
    measured = traced + OFFSETS[:, None]
    measured[..., 3] = 12
    expected = OFFSETS.copy()
    expected[:, 3] = 0
    np.testing.assert_array_equal(gain_db(measured, traced), expected)


def test_a_known_mixture_is_found_for_each_frequency():
    rendered, traced = levels(1), levels(2)
    weight = np.array([0.0, 0.25, 0.5, 0.75, 1.0])
    found = regress_weight(mix(rendered, traced, weight), rendered, traced)
    np.testing.assert_allclose(found, weight, atol=1e-12)


def test_the_weight_minimises_the_mean_absolute_error():
    rng = np.random.default_rng(3)
    rendered, traced = levels(1), levels(2)
    measured = mix(rendered, traced, 0.3) + rng.laplace(0, 5, SHAPE)
    found = regress_weight(measured, rendered, traced)

    def error(weight):
        return np.abs(mix(rendered, traced, weight) - measured).mean(axis=(0, 1, 2))

    for other in np.linspace(0, 1, 101):
        assert (error(found) <= error(other) + 1e-9).all()


def test_a_few_cells_that_are_far_off_change_little():
    rendered, traced = levels(1), levels(2)
    measured = mix(rendered, traced, 0.5)
    measured[0, 0, :5] += 500
    np.testing.assert_allclose(regress_weight(measured, rendered, traced), 0.5, atol=0.1)


def test_weights_stay_between_zero_and_one():
    rendered, traced = levels(1), levels(2)
    beyond = mix(rendered, traced, 3.0)
    np.testing.assert_array_equal(regress_weight(beyond, rendered, traced), np.ones(5))
    before = mix(rendered, traced, -3.0)
    np.testing.assert_array_equal(regress_weight(before, rendered, traced), np.zeros(5))


def test_equal_predictions_need_no_weight():
    same = levels()
    np.testing.assert_array_equal(regress_weight(levels(1), same, same), np.zeros(5))
