# SPDX-License-Identifier: MIT
import numpy as np
import pytest
import trimesh

from sononerf.errors import NumericalError
from sononerf.evaluation.baseline import best_level_surface
from sononerf.evaluation.metrics import geometry_metrics
from sononerf.evaluation.solid import sample_outer_surface
from sononerf.evaluation.true_surface import TrueSurface
from sononerf.surface.start.volume import volume_from_function


@pytest.fixture(scope="module")
def mesh():
    balls = [trimesh.creation.icosphere(subdivisions=3, radius=0.02) for _ in range(2)]
    balls[1].apply_translation([0.025, 0, 0])
    return trimesh.util.concatenate(balls)


def test_it_is_the_outer_surface(mesh):
    true = TrueSurface(mesh)
    assert true.components == 1
    # The middle of the lens lies 7.5 mm from either cap, which are no outer surface.
    assert true.nearest.distance(np.array([[0.0125, 0, 0]]))[0] > 0.014
    points, normals = true.samples(500, 3)
    expected = sample_outer_surface(mesh, 500, seed=3)
    np.testing.assert_array_equal(points, expected[0])
    np.testing.assert_array_equal(normals, expected[1])


def test_samples_are_kept_apart_by_count_and_seed(mesh):
    true = TrueSurface(mesh)
    assert true.samples(50, 0)[0] is true.samples(50, 0)[0]
    assert len(true.samples(60, 0)[0]) == 60
    assert (true.samples(50, 1)[0] != true.samples(50, 0)[0]).any()


def test_prepared_or_not_the_numbers_are_the_same(mesh):
    true = TrueSurface(mesh)
    found = trimesh.creation.icosphere(subdivisions=3, radius=0.03)
    for _ in range(2):  # the second time nothing is made anew
        prepared = geometry_metrics(found, true, samples=500)
        assert prepared == geometry_metrics(found, mesh, samples=500)
    volume = volume_from_function(
        lambda x: np.exp(-np.linalg.norm(x, axis=1) / 0.02), [-0.05] * 3, [0.05] * 3, 0.01
    )
    assert best_level_surface(volume, true)[1] == best_level_surface(volume, mesh)[1]


def test_nothing_is_no_truth():
    with pytest.raises(NumericalError, match="empty"):
        TrueSurface(trimesh.Trimesh())
