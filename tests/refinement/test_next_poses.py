# SPDX-License-Identifier: MIT
from __future__ import annotations

import numpy as np
import pytest
import trimesh

from sononerf.errors import InputError
from sononerf.geometry.poses import Poses
from sononerf.refinement.surface_error import next_poses
from sononerf.start.surface import Surface
from tests.memory import changed
from tests.refinement.conftest import RADIUS


@pytest.fixture(scope="module")
def mesh():
    return trimesh.creation.icosphere(subdivisions=4, radius=RADIUS)


def surface(mesh, error=1e-3):
    return Surface(mesh, error=np.full(len(mesh.vertices), error, dtype=np.float32))


@pytest.fixture(scope="module")
def from_above(echoes):
    """Echoes of which only the poses above the sphere are training poses."""
    return changed(echoes, split=np.where(echoes.positions[:, 2] > 0.05, 0, 2))


def test_the_side_that_no_pose_heard_comes_first(mesh, from_above):
    found = next_poses(surface(mesh), from_above, 6)
    assert (found.positions[:3, 2] < 0.08).all()  # no farther up than the lowest ones
    apart = np.linalg.norm(found.positions[:, None] - found.positions[None], axis=2)
    assert apart[np.triu_indices(6, 1)].min() > 0.1  # none hears what another one hears
    again = next_poses(surface(mesh), from_above, 6)
    assert np.array_equal(again.positions, found.positions)


def test_where_the_error_is_larger_is_heard_first(mesh, echoes):
    given = surface(mesh)
    given.error[mesh.vertices[:, 0] > 0.5 * RADIUS] = 2e-2
    found = next_poses(given, echoes, 2)
    assert (found.positions[:, 0] > 0.0).all()


def test_poses_keep_apart_from_those_that_heard(mesh, from_above):
    given = surface(mesh)
    given.error[mesh.vertices[:, 2] > 0.5 * RADIUS] = 1.0  # where all poses are
    found = next_poses(given, from_above, 1).positions / 0.3
    heard = from_above.positions[from_above.training] / 0.3
    below = np.linalg.norm(heard - [0.0, 0.0, -1.0], axis=1).min()
    assert np.linalg.norm(heard - found, axis=1).min() > 0.5 * below


def test_candidates_are_chosen_among(mesh, from_above):
    low, high = [0.0, 0.0, -0.3], [0.0, 0.0, 0.3]
    candidates = Poses.looking_at([high, low])
    found = next_poses(surface(mesh), from_above, 1, candidates=candidates)
    assert np.array_equal(found.positions, [low])


def test_a_cap_and_a_volume_keep_to_the_poses(mesh, from_above):
    cap = next_poses(surface(mesh), from_above, 5, within="cap")
    heard = from_above.positions[from_above.training]
    assert cap.positions[:, 2].min() > heard[:, 2].min() - 0.05
    volume = next_poses(surface(mesh), from_above, 5, within="volume")
    distance = np.linalg.norm(volume.positions, axis=1)
    assert distance.min() > 0.29
    assert distance.max() < 0.31


@pytest.mark.parametrize(
    ("options", "says"),
    [
        ({"count": 0}, "count: found 0"),
        ({"count": 2, "candidates": Poses.looking_at([[0.3, 0.0, 0.0]])}, "give 1 to 1"),
        ({"candidates": Poses.looking_at([[9.0, 0.0, 0.0]])}, "within 0.4 m"),
        ({"candidates": Poses.looking_at([[0.001, 0.0, 0.0]])}, "outside the box"),
        ({"within": "moon"}, "sphere, cap, volume"),
    ],
)
def test_bad_input_is_refused(mesh, echoes, options, says):
    given = {"count": 1, **options}
    with pytest.raises(InputError, match=says):
        next_poses(surface(mesh), echoes, given.pop("count"), **given)


def test_a_surface_without_errors_is_refused(mesh, echoes):
    with pytest.raises(InputError, match="refine it against its echoes first"):
        next_poses(Surface(mesh), echoes, 1)
