# SPDX-License-Identifier: MIT
import numpy as np
import pytest
import trimesh

from sononerf.errors import NumericalError
from sononerf.report.pictures.shading import averaged, background, camera_for, draw_mesh

FRONT = (1.0, 0.0, 0.0)


def draw(mesh, view=FRONT, size=(200, 160), colour=(0.5, 0.5, 0.5), fill=0.8):
    camera = camera_for(mesh.vertices, size=size, view=view, fill=fill)
    pixels = background(*size)
    return camera, pixels, draw_mesh(pixels, mesh, camera, colour)


def test_a_sphere_is_a_disc_of_its_size_in_the_middle():
    camera, _, nearness = draw(trimesh.creation.icosphere(subdivisions=4, radius=0.02))
    disc = np.isfinite(nearness)
    radius = 0.02 * camera.scale
    assert radius == pytest.approx(0.8 * 160 / 2, rel=2e-3)
    assert disc.sum() == pytest.approx(np.pi * radius**2, rel=0.01)
    rows, columns = np.nonzero(disc)
    assert rows.mean() == pytest.approx(79.5, abs=0.3)
    assert columns.mean() == pytest.approx(99.5, abs=0.3)
    assert nearness.max() == pytest.approx(0.02, rel=2e-3)


def test_from_the_front_y_is_right_and_z_is_up():
    camera = camera_for([[0, -1, -1], [0, 1, 1]], size=(100, 100), view=FRONT)
    (origin, right, up), nearness = camera.project([[0, 0, 0], [0, 1, 0], [1, 0, 1]])
    np.testing.assert_allclose(origin, [50, 50])
    assert right[0] > 50
    assert right[1] == pytest.approx(50)
    assert up[1] < 50
    np.testing.assert_allclose(nearness, [0, 0, 1], atol=1e-12)


def test_projection_and_drawing_agree():
    mesh = trimesh.creation.icosphere(subdivisions=3, radius=0.01)
    far = mesh.copy()
    far.apply_translation([0.0, 0.1, 0.05])
    camera, _, nearness = draw(trimesh.util.concatenate([mesh, far]), view=(1, 0.4, 0.3))
    (x, y), _ = camera.project(far.centroid)
    assert np.isfinite(nearness[round(y), round(x)])
    beyond = round(1.2 * 0.01 * camera.scale)
    assert not np.isfinite(nearness[round(y) - beyond, round(x)])


def test_the_nearer_body_hides_the_other():
    near, behind = trimesh.creation.box((0.02,) * 3), trimesh.creation.box((0.02,) * 3)
    behind.apply_translation([-0.1, 0, 0])
    both = trimesh.util.concatenate([behind, near])
    colours = np.repeat([[1.0, 0, 0], [0, 1.0, 0]], 8, axis=0)
    _, pixels, nearness = draw(both, colour=colours)
    red, green, _ = pixels[80, 100]
    assert green > 0.2 > red
    assert nearness[80, 100] == pytest.approx(0.06)


def test_the_side_to_the_light_is_brighter():
    _, pixels, _ = draw(trimesh.creation.icosphere(subdivisions=4))
    assert pixels[40, 80].sum() > pixels[125, 110].sum() + 0.3


def test_an_open_sheet_is_seen_from_both_sides_alike():
    sheet = trimesh.Trimesh([[0, -1, -1], [0, 1, -1], [0, 0, 1]], [[0, 1, 2]], process=False)
    back = trimesh.Trimesh(sheet.vertices, [[0, 2, 1]], process=False)
    np.testing.assert_allclose(draw(sheet)[1], draw(back)[1], atol=1e-12)
    assert np.isfinite(draw(sheet)[2]).sum() > 1000


def test_a_box_has_no_hole_where_triangles_meet():
    # Seen from the front the diagonals run exactly through pixel centres.
    _, _, nearness = draw(trimesh.creation.box((1, 1, 1)), size=(128, 128), fill=0.5)
    assert np.isfinite(nearness).sum() == 64 * 64


def test_looking_straight_down_works():
    camera, _, nearness = draw(trimesh.creation.box((1, 2, 3)), view=(0, 0, 1))
    np.testing.assert_allclose(camera.axes @ camera.axes.T, np.eye(3), atol=1e-12)
    assert np.isfinite(nearness).any()


def test_averaging():
    pixels = np.zeros((4, 4, 3))
    pixels[:2, :2] = 1
    pixels[2, 2] = 1
    small = averaged(pixels)
    assert small[0, 0, 0] == 255
    assert small[1, 1, 0] == 64
    assert small[0, 1, 0] == 0


def test_wrong_input_is_refused():
    with pytest.raises(NumericalError, match="empty"):
        camera_for(np.zeros((0, 3)), size=(10, 10))
    with pytest.raises(NumericalError, match="not finite"):
        camera_for([[np.nan, 0, 0]], size=(10, 10))
