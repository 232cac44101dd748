# SPDX-License-Identifier: MIT
import numpy as np
import pytest

from sononerf.surface.start.evidence import signed_distance

SIZE, MIDDLE = 32, 15.5
GRID = np.stack(np.meshgrid(*[np.arange(SIZE)] * 3, indexing="ij"), axis=-1) - MIDDLE
AWAY = np.linalg.norm(GRID, axis=-1).astype(np.float32)
NONE = np.zeros((SIZE,) * 3, np.float32)


def solve(weight=NONE, target=NONE, bound=None, pull=1e-3, empty=NONE):
    if bound is None:
        bound = AWAY - 14
    return signed_distance(weight, target, bound, pull, empty, 1.0)


def test_without_evidence_the_body_reaches_as_far_as_it_may():
    found = solve(pull=0.1)
    near = (np.abs(AWAY - 14) < 2) & (np.abs(GRID) < 13).all(axis=-1)
    assert np.abs(found - (AWAY - 14))[near].max() < 0.7


def test_evidence_draws_the_surface_inside_of_the_bound():
    shell = (np.abs(AWAY - 9) < 1.5).astype(np.float32)
    found = solve(shell, AWAY - 9)
    inside = AWAY[found < 0]
    assert inside.max() < 10
    assert np.abs(found[shell > 0] - (AWAY - 9)[shell > 0]).max() < 0.5


def test_between_evidence_the_surface_goes_on_smoothly():
    shell = (np.abs(AWAY - 9) < 1.5) & (np.abs(GRID[..., 2]) > 3)
    found = solve(shell.astype(np.float32), AWAY - 9, pull=1e-5)
    line = found[:, 15, 15]
    outermost = np.interp(0, line[16:], np.arange(16, SIZE) - MIDDLE)
    assert outermost == pytest.approx(9, abs=1.0)  # where nothing was heard, between two caps


def test_free_space_wins_over_evidence_in_front_of_it():
    shell = (np.abs(AWAY - 13) < 1.5).astype(np.float32)
    found = solve(0.2 * shell, AWAY - 13, bound=AWAY - 9)
    assert AWAY[found < 0].max() < 11


def test_what_is_far_off_the_surface_hardly_counts():
    shell = (np.abs(AWAY - 9) < 1.5).astype(np.float32)
    wrong = AWAY - 9
    wrong[:, :, 12:14] += 12.0
    found = solve(shell, wrong)
    clean = solve(shell, AWAY - 9)
    assert np.abs(found - clean)[shell > 0].mean() < 0.5


def test_a_place_that_is_empty_is_carved_out():
    ahead = (GRID[..., 2] > 3).astype(np.float32)
    assert (solve(pull=0.01)[..., 24] < 0).any()
    assert not (solve(pull=0.01, empty=0.1 * ahead)[..., 24] < 0).any()
