# SPDX-License-Identifier: MIT
import io

import numpy as np
from PIL import Image

from sononerf.report.pictures.figure import figure, pixels_from_figure, png_from_pixels


def test_pixels_survive_the_file():
    pixels = np.random.default_rng(0).integers(0, 256, (5, 7, 3), dtype=np.uint8)
    data = png_from_pixels(pixels)
    np.testing.assert_array_equal(np.asarray(Image.open(io.BytesIO(data))), pixels)


def test_a_figure_has_its_size_and_leaves_the_users_style_alone():
    import matplotlib

    before = matplotlib.rcParams["font.size"]
    with figure(2, 1.5, 100) as drawn:
        drawn.subplots().plot([0, 1])
        pixels = pixels_from_figure(drawn)
    assert pixels.shape == (150, 200, 3)
    assert pixels.dtype == np.uint8
    assert matplotlib.rcParams["font.size"] == before
