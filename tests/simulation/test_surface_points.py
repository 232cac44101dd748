# SPDX-License-Identifier: MIT
import math

import numpy as np
import pytest
import trimesh

from sononerf.geometry.poses import rotation_from_euler
from sononerf.geometry.raycast import RayCaster
from sononerf.simulation.diffraction import Outlines
from sononerf.simulation.surface_points import MOST_CELLS, SurfacePoints
from tests.simulation.listening import ball, box, wall

WAVELENGTH = 343.0 / 80e3


def points_of(mesh, wavelength=WAVELENGTH):
    closed = Outlines(mesh).closed
    return SurfacePoints(mesh, RayCaster(mesh), closed, wavelength=wavelength)


@pytest.mark.parametrize(
    "mesh",
    [
        ball(0.02),
        ball(0.02, subdivisions=1),
        box([-0.03] * 3, [0.03] * 3),
        wall(0.3, (-1, -1), (1, 1)),
    ],
)
def test_no_area_is_lost_nor_counted_twice(mesh):
    assert points_of(mesh).area.sum() == pytest.approx(mesh.area, rel=1e-9)


def test_points_light_as_much_as_their_surface_does():
    """From the middle of a hollow ball all of the solid angle, from outside that of the disc."""
    hollow = ball(0.1)
    hollow.invert()
    for mesh in (ball(0.1), hollow):  # inside out or not
        bounce = points_of(mesh).lit_from(np.array([0.4, 0.0, 0.0]))
        seen = np.einsum("nd,nd->n", bounce.emitted, bounce.points) < 0.0
        expected = 2.0 * math.pi * (1.0 - math.cos(math.asin(0.1 / 0.4)))
        assert bounce.solid_angle[seen].sum() == pytest.approx(expected, rel=0.01)
        assert seen.mean() > 0.95
    np.testing.assert_allclose(np.linalg.norm(bounce.points, axis=1), 0.1, rtol=1e-3)


def test_both_sides_of_a_sheet_face_a_place():
    sheet = wall(0.0, (-0.01, -0.01), (0.01, 0.01))
    found = points_of(sheet)
    for side in (-0.3, 0.3):
        bounce = found.lit_from(np.array([side, 0.0, 0.0]))
        assert len(bounce.ray) == len(found.area)
        assert (np.einsum("nd,nd->n", bounce.emitted, bounce.flat) < 0.0).all()


def test_cells_are_finer_where_the_surface_is_more_curved_and_scale_with_the_wavelength():
    coarse, fine = points_of(ball(0.05)), points_of(ball(0.005))
    assert coarse.area.mean() > 4.0 * fine.area.mean()
    twice = ball(0.01)
    assert len(points_of(twice, 2.0 * WAVELENGTH).area) == pytest.approx(len(fine.area), rel=1e-6)


def test_a_room_has_no_more_points_than_fit_into_memory():
    assert len(points_of(box([-4.0, -4.0, -2.0], [4.0, 4.0, 2.0])).area) <= 4 * MOST_CELLS


def test_a_mesh_turned_by_a_right_angle_has_its_points_turned():
    mesh = trimesh.util.concatenate(
        [ball(0.01, (0.02, 0.0, 0.01), 3), ball(0.02, (-0.02, 0, 0), 3)]
    )
    turn = rotation_from_euler(math.pi / 2.0, 0.0, 0.0)
    moved = trimesh.Trimesh(mesh.vertices @ turn.T, mesh.faces, process=False)
    one, two = points_of(mesh), points_of(moved)
    # Vertices that lie on a border of cells may go either way.
    assert len(one.area) == pytest.approx(len(two.area), rel=0.02)
