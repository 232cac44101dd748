# SPDX-License-Identifier: MIT
import io

import numpy as np
import pytest
from PIL import Image

from sononerf.evaluation.numbers import compare
from sononerf.geometry.lattice import grid_over
from sononerf.report.mip_picture import difference_pngs

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
