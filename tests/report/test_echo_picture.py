# SPDX-License-Identifier: MIT
import io

import numpy as np
import pytest
import trimesh
from PIL import Image

from sononerf.errors import NumericalError
from sononerf.geometry.poses import look_at
from sononerf.report.figure import background, camera_for, draw_mesh
from sononerf.report.scene_picture import EARS, echo_png, visible_hits

RANGE = np.linspace(0.15, 0.75, 121)
FREQUENCY = np.linspace(10e3, 100e3, 47)
HEAD = np.array([0.4, 0.0, 0.0])
AHEAD = look_at(HEAD, np.zeros(3))
SIZE = (300, 300)


@pytest.fixture(scope="module")
def ball():
    return trimesh.creation.icosphere(subdivisions=3, radius=0.1)


def wave(centre=0.4):
    time = np.arange(5000) / 1e6
    return np.sin(2e5 * time) * np.exp(-(((343 * time / 2 - centre) / 0.01) ** 2))


def sounds(centre=0.4):
    profile = 40 * np.exp(-(((RANGE - centre) / 0.01) ** 2))
    return np.broadcast_to(profile[:, None], (121, 47))


def draw(ball, **changes):
    given = {
        "points": [[0.1, 0.0, 0.0]],
        "level_db": [-50.0],
        "position": HEAD,
        "rotation": AHEAD,
        "echo": np.stack([wave(), wave()]),
        "spectrogram_db": np.stack([sounds(), sounds()]),
        "range_m": RANGE,
        "frequency_hz": FREQUENCY,
        **changes,
    }
    return echo_png(ball, sampling_rate=1e6, speed_of_sound=343.0, **given)


def pixels(data):
    return np.asarray(Image.open(io.BytesIO(data))).astype(int)


def like(image, colour, tolerance=12):
    return (np.abs(image.astype(int) - colour) <= tolerance).all(axis=-1)


def test_a_picture_is_a_png_and_always_the_same(ball):
    data = draw(ball)
    assert data == draw(ball)
    assert pixels(data).shape == (858, 1690, 3)


def columns(drawn, colour):
    found = np.flatnonzero(like(drawn[100:440, 900:], colour, 60).sum(axis=0) > 8)
    return found.mean() if len(found) else None


def test_each_ear_has_its_own_wave_at_its_range(ball):
    both = sounds(0.35) + sounds(0.45)
    given = {"echo": np.stack([wave(0.35), wave(0.45)]), "spectrogram_db": np.stack([both, both])}
    drawn = pixels(draw(ball, **given))
    left, right = (columns(drawn, colour) for colour in EARS)
    # From 0.314 to 0.486 m is shown on some 690 pixels; the two lie 0.1 m apart.
    assert right - left == pytest.approx(0.1 / 0.172 * 690, rel=0.15)
    silent = pixels(
        draw(ball, echo=np.stack([wave(0.35), 0 * wave()]), spectrogram_db=[both, both])
    )
    assert columns(silent, EARS[1]) is None
    assert columns(silent, EARS[0]) == pytest.approx(left, abs=3)


def test_each_ear_has_its_own_spectrogram(ball):
    one = np.stack([sounds(), 0 * sounds()])
    bright = pixels(draw(ball, spectrogram_db=one))[:, 920:1590].sum(axis=-1) > 450
    other = pixels(draw(ball, spectrogram_db=one[::-1]))[:, 920:1590].sum(axis=-1) > 450
    upper, lower = slice(400, 560), slice(625, 780)
    assert bright[upper].sum() > 10 * bright[lower].sum()
    assert other[lower].sum() > 10 * other[upper].sum()


def test_hits_show_where_the_camera_sees_them(ball):
    camera = camera_for(ball.vertices, size=SIZE, view=(1.0, 0.0, 0.0))
    nearness = draw_mesh(background(*SIZE), ball, camera, (1.0, 1.0, 1.0))
    points = np.array([[0.1, 0, 0], [-0.1, 0, 0], [0.1, 0, 0], [0.1, 0, 0], [0.1, 9, 0]])
    levels = np.array([0.0, 0.0, -39.0, -41.0, 0.0])
    seen = visible_hits(points, levels, camera, nearness, 0.002)
    assert seen.tolist() == [2, 0]  # the loudest last


@pytest.mark.slow
@pytest.mark.parametrize("position", [[-0.2, -0.3, 0.2], [0.0, 0.0, 0.5]])
def test_the_head_has_its_left_ear_on_its_left(ball, position):
    given = {"position": position, "rotation": look_at(position, np.zeros(3))}
    image = pixels(draw(ball, points=np.zeros((0, 3)), level_db=[], **given))[:700, :800]
    left, right = (np.argwhere(like(image, colour, 12)).mean(axis=0) for colour in EARS)
    # The camera stands behind the head, so its left is the picture's left.
    assert left[1] < right[1] - 3


def test_silence_without_hits(ball):
    silent = {"echo": np.zeros((2, 100)), "spectrogram_db": np.zeros((2, 121, 47))}
    drawn = pixels(draw(ball, points=np.zeros((0, 3)), level_db=[], **silent))
    assert (drawn[400:800, 1000:1500].sum(axis=-1) < 250).mean() > 0.8  # dark
    assert (drawn[100:300, 1000:1500].sum(axis=-1) > 700).mean() > 0.8  # two flat lines on white


def test_wrong_input_is_refused(ball):
    with pytest.raises(NumericalError, match="empty"):
        draw(trimesh.Trimesh())


@pytest.mark.slow
@pytest.mark.parametrize("receivers", [1, 3])
def test_any_number_of_receivers(ball, receivers):
    data = draw(
        ball, echo=np.stack([wave()] * receivers), spectrogram_db=np.stack([sounds()] * receivers)
    )
    image = pixels(data)
    view = image[:, : int(0.45 * image.shape[1])]
    for colour in EARS:  # no left and right ear on its head
        assert not like(view, colour, 12).any()
