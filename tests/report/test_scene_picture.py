# SPDX-License-Identifier: MIT
import io

import numpy as np
import pytest
import trimesh
from PIL import Image

from sononerf.errors import NumericalError
from sononerf.report.scene_picture import scene_png

SIZE = (320, 260)


@pytest.fixture(scope="module")
def ball():
    return trimesh.creation.icosphere(subdivisions=3, radius=0.05)


def pixels(data):
    return np.asarray(Image.open(io.BytesIO(data))).astype(int)


def sphere_poses(count=60):
    directions = np.random.default_rng(0).normal(size=(count, 3))
    directions /= np.linalg.norm(directions, axis=1, keepdims=True)
    return 0.4 * directions, -directions


def orange(data):
    drawn = pixels(data)[:190]  # above the axes
    return ((drawn[..., 0] > drawn[..., 2] + 60) & (drawn[..., 0] > 150)).sum()


def test_a_picture_is_a_png_and_always_the_same(ball):
    box = ([-0.1] * 3, [0.1] * 3)
    data = scene_png(ball, *sphere_poses(), box, size=SIZE)
    assert data == scene_png(ball, *sphere_poses(), box, size=SIZE)
    assert pixels(data).shape == (260, 320, 3)
    assert data != scene_png(ball, *sphere_poses(), size=SIZE)


def test_poses_show_in_front_and_not_through_the_body(ball):
    view = (1.0, 0.0, 0.0)
    front = scene_png(ball, [[0.4, 0, 0]], [[-1, 0, 0]], size=SIZE, view=view)
    back = scene_png(ball, [[-0.4, 0, 0]], [[1, 0, 0]], size=SIZE, view=view)
    assert orange(front) > orange(back) + 10


def test_splits_have_colours_of_their_own(ball):
    def counts(split):
        drawn = pixels(scene_png(ball, *sphere_poses(), size=SIZE, split=split))[25:]
        red, green, blue = np.moveaxis(drawn[:190], -1, 0)
        # Below the legend and above the axes, whose colours are much the same.
        return [
            int(((red > blue + 60) & (red > 150)).sum()),
            int(((green > red + 60) & (green > blue + 20)).sum()),
            int(((blue > red + 90) & (blue > green + 60)).sum()),
        ]

    train, validation, test = (counts(np.full(60, kind)) for kind in range(3))
    assert [found.index(max(found)) for found in (train, validation, test)] == [0, 1, 2]
    for found in (train, validation, test):
        assert sorted(found)[1] == 0
    mixed = counts(np.repeat([0, 1, 2], 20))
    assert min(mixed) > 20


def test_wrong_input_is_refused(ball):
    positions, forward = sphere_poses(3)
    with pytest.raises(NumericalError, match="empty"):
        scene_png(trimesh.Trimesh(), positions, forward)
    with pytest.raises(NumericalError, match="not finite"):
        scene_png(ball, positions * np.nan, forward)
