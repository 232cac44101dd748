# SPDX-License-Identifier: MIT
import numpy as np
import pytest
import trimesh

from sononerf.errors import InputError
from sononerf.simulation.reference.boundary_mesh import (
    check_apart,
    closed_bodies,
    expected_vertices,
    halved,
    suited,
)
from tests.simulation.listening import ball, wall

pytestmark = pytest.mark.thorough

PLATE = trimesh.creation.box((0.04, 0.03, 0.0003))


def test_a_mesh_is_divided_without_holes_or_slivers():
    found = halved(PLATE, 0.002)
    assert found.is_watertight
    assert found.is_winding_consistent
    assert found.volume == pytest.approx(PLATE.volume, rel=1e-9)
    assert found.edges_unique_length.max() <= 0.002
    assert found.edges_unique_length.min() > 0.00029  # the plate's own thickness
    assert len(found.vertices) < 2 * expected_vertices(PLATE.area, 0.0015)


def test_a_curved_surface_stays_where_it_is_when_it_is_divided():
    coarse = ball(0.02, subdivisions=2)
    found = halved(coarse, 0.003)
    assert found.is_watertight
    assert found.volume == pytest.approx(coarse.volume, rel=1e-9)


@pytest.mark.parametrize("edge", [0.002, 0.004])
def test_a_fine_mesh_is_made_coarser_and_keeps_its_shape(edge):
    fine = ball(0.02, subdivisions=5)
    found = suited(closed_bodies(fine), edge)
    assert found.is_watertight
    assert len(found.vertices) < 1.3 * expected_vertices(fine.area, edge)
    radius = np.linalg.norm(found.vertices, axis=1)
    assert np.abs(radius - 0.02).max() < 0.05 * edge
    assert found.volume == pytest.approx(fine.volume, rel=0.01)


@pytest.mark.slow
def test_a_thin_plate_keeps_both_sides_when_it_is_made_coarser():
    found = suited(closed_bodies(halved(PLATE, 0.0006)), 0.003)
    assert found.is_watertight
    assert found.volume == pytest.approx(PLATE.volume, rel=1e-3)
    assert len(found.vertices) < 1.5 * expected_vertices(PLATE.area, 0.003)


def test_an_open_surface_is_refused():
    with pytest.raises(InputError, match="needs closed bodies; 4 edges"):
        closed_bodies(wall(0.3, (-0.1, -0.1), (0.1, 0.1)))


def test_vertices_that_stand_twice_are_merged():
    loose = ball(0.02, subdivisions=2)
    loose.unmerge_vertices()
    assert closed_bodies(loose).is_watertight


def test_bodies_that_overlap_or_are_inside_out_are_refused():
    apart = trimesh.util.concatenate([ball(0.02, subdivisions=2), ball(0.02, (0.1, 0, 0), 2)])
    check_apart(closed_bodies(apart))
    close = [ball(0.02, subdivisions=2), ball(0.02, (0.03, 0, 0), 2)]
    with pytest.raises(InputError, match="lie apart"):
        check_apart(closed_bodies(trimesh.util.concatenate(close)))
    inverted = ball(0.02, subdivisions=2)
    inverted.invert()
    with pytest.raises(InputError, match="320 of 320"):
        check_apart(closed_bodies(inverted))
