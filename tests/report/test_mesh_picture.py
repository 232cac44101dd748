# SPDX-License-Identifier: MIT
import io

import numpy as np
import pytest
import trimesh
from PIL import Image

from sononerf.errors import NumericalError
from sononerf.report.mesh_picture import confidence_png, mesh_png, side_by_side_png

SIZE = (240, 180)


def pixels(data):
    return np.asarray(Image.open(io.BytesIO(data)))


@pytest.fixture(scope="module")
def ball():
    return trimesh.creation.icosphere(subdivisions=3, radius=0.015)


def test_a_picture_is_a_png_and_always_the_same(ball):
    data = mesh_png(ball, size=SIZE)
    assert pixels(data).shape == (180, 240, 3)
    assert data == mesh_png(ball.copy(), size=SIZE)
    middle, corner = pixels(data)[90, 120].astype(int), pixels(data)[5, 5].astype(int)
    assert np.abs(middle - corner).max() > 40


def test_colours_one_for_all_or_per_vertex(ball):
    red = pixels(mesh_png(ball, size=SIZE, colours=(0.9, 0.1, 0.1)))[90, 120]
    assert red[0] > 3 * red[2]
    upper = np.where(ball.vertices[:, 2:] > 0, [0.0, 0, 0.9], [0.9, 0, 0])
    drawn = pixels(mesh_png(ball, size=SIZE, colours=upper)).astype(int)
    assert drawn[50, 120, 2] > drawn[50, 120, 0]
    assert drawn[135, 120, 0] > drawn[135, 120, 2]


def test_both_halves_share_one_camera(ball):
    small = ball.copy()
    small.apply_scale(0.5)
    data = side_by_side_png(ball, small, ("truth", "reconstruction"), size=SIZE)
    drawn = pixels(data).astype(int)
    assert drawn.shape == (180, 484, 3)

    def wide(half):
        # Bodies are coloured, the background is grey.
        return (np.ptp(half[90], axis=1) > 20).sum()

    assert wide(drawn[:, :240]) == pytest.approx(2 * wide(drawn[:, 244:]), abs=4)


def test_a_single_triangle_is_drawn():
    triangle = trimesh.Trimesh([[0, 0, 0], [0, 0.01, 0], [0, 0, 0.01]], [[0, 1, 2]], process=False)
    assert pixels(mesh_png(triangle, size=SIZE)).std() > 5


def test_nothing_to_draw_is_an_error(ball):
    with pytest.raises(NumericalError, match="the mesh is empty"):
        mesh_png(trimesh.Trimesh())
    with pytest.raises(NumericalError, match="reconstruction is empty"):
        side_by_side_png(ball, trimesh.Trimesh())
    broken = trimesh.Trimesh([[0, 0, 0], [1, 0, 0], [0, np.nan, 0]], [[0, 1, 2]], process=False)
    with pytest.raises(NumericalError, match="not finite"):
        mesh_png(broken)


def test_confidence_is_drawn_bright_where_many_poses_heard(ball):
    counts = np.where(ball.vertices[:, 2] < 0, 100, 0)  # though light falls from above
    data = confidence_png(ball, counts, size=(480, 360))
    assert data == confidence_png(ball.copy(), counts, size=(480, 360))
    drawn = pixels(data).astype(int)
    assert drawn.shape == (360, 480, 3)
    assert drawn[270, 240, 0] > drawn[100, 240, 0] + 50
    # The bar in the lower left corner runs from dark to bright yellow.
    yellow = drawn[..., 0] - drawn[..., 2] > 90
    assert yellow[300:, :250].any()
    with pytest.raises(NumericalError, match="empty"):
        confidence_png(trimesh.Trimesh(), [])
