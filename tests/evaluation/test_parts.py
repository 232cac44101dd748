# SPDX-License-Identifier: MIT
import numpy as np
import pytest
import trimesh

from sononerf.errors import NumericalError
from sononerf.evaluation.parts import clean_mesh, split_parts


def sphere(radius, x):
    mesh = trimesh.creation.icosphere(subdivisions=2, radius=radius)
    mesh.apply_translation([x, 0, 0])
    return mesh


def test_parts_come_largest_first_and_whole():
    parts = split_parts(trimesh.util.concatenate([sphere(1, 0), sphere(2, 5), sphere(1.5, 10)]))
    np.testing.assert_allclose([part.centroid[0] for part in parts], [5, 10, 0], atol=1e-9)
    assert all(part.is_watertight for part in parts)


def test_an_empty_mesh_has_no_parts():
    assert split_parts(trimesh.Trimesh()) == []


def test_crumbs_go_and_the_rest_stays():
    mesh = trimesh.util.concatenate([sphere(1, 0), sphere(0.09, 5), sphere(0.11, 10)])
    # Areas go with the square of the radius: 0.8 % and 1.2 % of the largest.
    assert len(split_parts(clean_mesh(mesh))) == 2
    assert len(split_parts(clean_mesh(mesh, min_area_fraction=0.0))) == 3
    assert len(split_parts(clean_mesh(mesh, min_area_fraction=1.0))) == 1


def test_wrong_input_is_refused():
    with pytest.raises(NumericalError, match="empty"):
        clean_mesh(trimesh.Trimesh())
    with pytest.raises(ValueError, match="min_area_fraction"):
        clean_mesh(sphere(1, 0), min_area_fraction=2.0)
