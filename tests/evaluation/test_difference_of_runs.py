# SPDX-License-Identifier: MIT
import numpy as np
import pytest
import trimesh

from sononerf.errors import NumericalError
from sononerf.evaluation.numbers import added_part, compare
from sononerf.geometry.lattice import Volume, grid_over

GRID = grid_over([-0.03] * 3, [0.03] * 3, 0.005)


def bump(place, height=1.0, width=0.006):
    """A Gaussian about a place, m."""
    distance = np.linalg.norm(GRID.points() - place, axis=1)
    values = height * np.exp(-0.5 * (distance / width) ** 2)
    return values.reshape(GRID.shape)


def test_what_only_the_first_has_is_found_where_it_is():
    both, more = bump([0.0, 0.0, -0.015]), bump([0.0, 0.01, 0.015], 0.5)
    found = compare(GRID.with_values(both + more), GRID.with_values(both))
    np.testing.assert_allclose(found.strongest, [0.0, 0.01, 0.015], atol=1e-9)
    np.testing.assert_allclose(found.difference.values, found.first.values - found.second.values)
    assert found.score == pytest.approx(0.5, rel=0.01)
    # What is missing from the first is no place of its own.
    turned = compare(GRID.with_values(both), GRID.with_values(both + more))
    assert turned.score < 0.01
    np.testing.assert_allclose(turned.difference.values, -found.difference.values)


def test_the_common_maximum_is_one():
    faint, loud = GRID.with_values(bump([0, 0, 0], 1e-9)), GRID.with_values(bump([0, 0, 0], 4e-9))
    for pair in ((faint, loud), (loud, faint)):
        found = compare(*pair)
        assert max(found.first.values.max(), found.second.values.max()) == pytest.approx(1.0)
        assert min(found.first.values.max(), found.second.values.max()) == pytest.approx(0.25)


def test_equal_fields_do_not_differ():
    one = GRID.with_values(bump([0, 0, 0]))
    found = compare(one, one)
    assert found.score == 0
    assert found.strongest is None
    assert (found.difference.values == 0).all()


def test_what_is_weaker_everywhere_is_strongest_nowhere():
    found = compare(GRID.with_values(bump([0, 0, 0])), GRID.with_values(bump([0, 0, 0]) + 1.0))
    assert found.score < 0
    assert found.strongest is None


def test_what_cannot_be_compared():
    one = GRID.with_values(bump([0, 0, 0]))
    with pytest.raises(ValueError, match="different grids"):
        compare(one, Volume(one.values, one.origin + 0.001, one.spacing))
    with pytest.raises(ValueError, match="different grids"):
        compare(one, Volume(one.values, one.origin, 0.004))
    with pytest.raises(NumericalError, match="both are silent"):
        compare(GRID, GRID)


def test_what_was_added_is_told_from_what_was_there():
    body = trimesh.creation.box((0.1, 0.02, 0.1))
    more = trimesh.creation.icosphere(radius=0.01).apply_translation([0.0, 0.02, 0.03])
    both = trimesh.util.concatenate([body, more])
    found = added_part(both, body)
    assert len(found.faces) == len(more.faces)
    np.testing.assert_allclose(found.bounds, more.bounds)
    assert added_part(body, both) is None
    assert added_part(body, body) is None
