# SPDX-License-Identifier: MIT

import io

import numpy as np
import pytest
from PIL import Image

from sononerf.errors import NumericalError
from sononerf.evaluation.numbers import compare
from sononerf.geometry.lattice import Volume, grid_over
from sononerf.report.mip_picture import difference_pngs, mip_image, mip_picture, mips_image

EXTENTS = ((-0.05, 0.05), (0.0, 0.06))


def test_an_image_has_its_first_axis_to_the_right_and_its_second_upwards():
    projection = np.zeros((10, 6))
    projection[9, 0] = 1.0
    pixels = mip_image(projection, longest=10)
    assert pixels.shape == (6, 10, 3)
    brightness = pixels.astype(int).sum(axis=2)
    assert np.unravel_index(brightness.argmax(), brightness.shape) == (5, 9)
    assert mip_image(projection, longest=40).shape == (24, 40, 3)


def test_decibels_show_what_linear_hides():
    projection = np.array([[1.0, 1e-3]])
    decibels = mip_image(projection, longest=2).astype(int).sum(axis=2)
    linear = mip_image(projection, scale="linear", longest=2).astype(int).sum(axis=2)
    assert decibels[0, 0] > linear[0, 0] + 50
    # -30 of 40 dB is a quarter of the map, 1e-3 its very foot.
    assert linear[0, 0] < 20


def test_a_picture_is_a_png_and_always_the_same():
    projection = np.random.default_rng(0).random((20, 12))
    data = mip_picture(projection, EXTENTS, ("y", "z"), title="maximum along x")
    assert data == mip_picture(projection, EXTENTS, ("y", "z"), title="maximum along x")
    width, height = Image.open(io.BytesIO(data)).size
    assert width > height > 200


def test_wrong_input_is_refused():
    with pytest.raises(NumericalError, match="not finite"):
        mip_picture([[np.nan]], EXTENTS, ("y", "z"))


def test_three_projections_in_one_picture_have_their_places():
    """A bright corner at great y and small z is at the left below along x and y, not along z."""
    values = np.full((20, 20, 20), 1e-4)
    values[:, 14:, :6] = 1.0
    pixels = mips_image(Volume(values, np.zeros(3), 0.001)).astype(int)
    bright = (pixels[..., 0] > 240) & (pixels[..., 2] > 120) & (pixels[..., 2] < 220)
    third = pixels.shape[1] // 3
    along_x, along_y, along_z = (bright[:, n * third : (n + 1) * third - 60] for n in range(3))
    rows, columns = np.nonzero(along_x)
    assert rows.min() > pixels.shape[0] / 2  # z upwards
    assert columns.min() > third / 2  # y to the right
    assert np.nonzero(along_y)[0].min() > pixels.shape[0] / 2
    assert np.nonzero(along_z)[0].max() < pixels.shape[0] / 2  # y upwards


GRID = grid_over([-0.03, -0.02, -0.05], [0.03, 0.02, 0.05], 0.005)
MORE, LESS = np.array([0.02, -0.01, 0.03]), np.array([-0.02, 0.01, -0.03])


def bump(place):
    distance = np.linalg.norm(GRID.points() - place, axis=1)
    return np.exp(-0.5 * (distance / 0.008) ** 2).reshape(GRID.shape)


@pytest.fixture(scope="module")
def comparison():
    return compare(GRID.with_values(bump(MORE)), GRID.with_values(0.6 * bump(LESS)))


def pixels(data):
    with Image.open(io.BytesIO(data)) as image:
        return np.asarray(image.convert("RGB")).astype(int)


def test_one_picture_along_each_axis(comparison):
    drawn = difference_pngs(comparison, ("with", "without"))
    assert list(drawn) == ["x", "y", "z"]
    # Three panels, each as high as it is wide in metres.
    shapes = {name: pixels(data).shape for name, data in drawn.items()}
    assert shapes["x"][0] > shapes["z"][0]
    assert drawn == difference_pngs(comparison, ("with", "without"))


def test_more_is_red_and_less_is_blue_where_they_are(comparison):
    """Seen along x: more to the left (y = -10 mm) and above, less to the right and below."""
    picture = pixels(difference_pngs(comparison, ("with", "without"))["x"])
    panel = picture[:, 2 * picture.shape[1] // 3 :]
    red = np.argwhere((panel[..., 0] - panel[..., 2] > 60) & (panel[..., 1] < 160))
    blue = np.argwhere((panel[..., 2] - panel[..., 0] > 40) & (panel[..., 1] < 200))
    bar = panel.shape[1] // 2  # to the right of it stands the colour bar
    red, blue = red[red[:, 1] < bar].mean(axis=0), blue[blue[:, 1] < bar].mean(axis=0)
    assert red[0] < blue[0] - 20
    assert red[1] < blue[1] - 5
