# SPDX-License-Identifier: MIT


from __future__ import annotations

import io

import numpy as np
import pytest
from PIL import Image

from sononerf.geometry.poses import Poses
from sononerf.report.spectrogram_picture import (
    LIVE_DB,
    pings_png,
    quick_image,
    sounding_slice,
    spectrogram_image,
    spectrogram_picture,
)

RANGE = np.linspace(0.15, 0.75, 121)
FREQUENCY = np.linspace(10e3, 100e3, 47)


def echo(ears=2):
    profile = 40 * np.exp(-(((RANGE - 0.4) / 0.01) ** 2))
    return np.broadcast_to(profile[:, None], (ears, 121, 47))


def test_a_picture_is_a_png_and_always_the_same():
    first = spectrogram_picture(echo(), 0.9 * echo(), RANGE, FREQUENCY, "pose 3")
    assert first == spectrogram_picture(echo(), 0.9 * echo(), RANGE, FREQUENCY, "pose 3")
    assert Image.open(io.BytesIO(first)).size == (1365, 715)


def test_only_what_sounds_is_shown():
    shown = RANGE[sounding_slice(echo(), RANGE)]
    # 40 dB falls to 3 dB within 0.01 sqrt(ln(40 / 3)) = 16 mm, and 20 mm are added.
    assert shown[0] == pytest.approx(0.364, abs=0.005)
    assert shown[-1] == pytest.approx(0.436, abs=0.005)
    assert sounding_slice(0 * echo(), RANGE) == slice(0, 121)
    one = np.zeros((2, 121, 47))
    one[1, 0, 0] = 50
    assert sounding_slice(one, RANGE).start == 0


@pytest.mark.parametrize("ears", [1, 2, 3])
def test_any_number_of_ears_and_silence(ears):
    pixels = spectrogram_image(0 * echo(ears), 0 * echo(ears), RANGE, FREQUENCY)
    assert pixels.dtype == np.uint8
    assert pixels.shape[2] == 3
    assert pixels.std() > 1


def test_a_prediction_alone_has_one_panel():
    pixels = spectrogram_image(None, [[[5.0]]], [0.4], [40e3])
    both = spectrogram_image([[[5.0]]], [[[5.0]]], [0.4], [40e3])
    assert pixels.shape[0] == both.shape[0]
    assert 0.3 < pixels.shape[1] / both.shape[1] < 0.5
    middle = pixels[pixels.shape[0] // 2, pixels.shape[1] // 2].astype(int)
    np.testing.assert_allclose(middle, [252, 253, 191], atol=24)  # the top of the scale
    assert spectrogram_picture(None, echo(), RANGE, FREQUENCY)


def test_a_logarithmic_axis_is_drawn_as_one():
    """A tone at the geometric mean of the ends is drawn half-way up, and no channel is lost."""
    frequency = np.geomspace(10e3, 100e3, 48)
    level = np.zeros((1, 121, 48))
    level[..., 23:25] = 40.0
    level[:, :, 0] = 40.0
    image = spectrogram_image(level, level, RANGE, frequency)
    column = image[:, 110].astype(int).sum(axis=1)
    inside = np.flatnonzero(image[:, 110].max(axis=1) < 250)  # panel, but for the bright tone
    top, bottom = inside.min(), inside.max()
    bright = np.flatnonzero(column[top : bottom + 12] > 500)
    middle = bright[bright < 0.9 * (bottom - top)]
    assert middle.mean() == pytest.approx((bottom - top) / 2, abs=5)
    assert (bright > 0.95 * (bottom - top)).any()  # the lowest channel


@pytest.mark.parametrize(("pings", "receivers"), [(1, 1), (3, 2)])
def test_a_row_for_each_ping(pings, receivers):
    rng = np.random.default_rng(0)
    poses = Poses.sphere(9, radius=0.4, aim_jitter=0.1, generator=rng)

    def picture(level):
        return pings_png(
            [level * rng.standard_normal((receivers, 100)) for _ in range(pings)],
            [level * rng.random((receivers, 20, 5)) for _ in range(pings)],
            [f"ping {index}" for index in range(pings)],
            sampling_rate=1e6,
            range_m=np.linspace(0.3, 0.5, 20),
            frequency_hz=np.linspace(20e3, 80e3, 5),
            poses=poses,
        )

    image = np.asarray(Image.open(io.BytesIO(picture(1.0))).convert("RGB"))
    assert image.shape[0] == round((3.4 + 2.2 * pings) * 100)
    half = image.shape[1] // 2
    for row in range(pings):
        top = round((3.4 + 2.2 * row) * 100)
        colours = np.unique(image[top : top + 220, half:].reshape(-1, 3), axis=0)
        assert len(colours) > 60  # a spectrogram is there
    assert picture(0.0)  # silence too


def test_a_measurement_alone_is_not_called_a_prediction():
    measured = spectrogram_picture(echo(), None, RANGE, FREQUENCY, "pose 3")
    predicted = spectrogram_picture(None, echo(), RANGE, FREQUENCY, "pose 3")
    assert measured != predicted  # the same cells under another title
    assert Image.open(io.BytesIO(measured)).size == Image.open(io.BytesIO(predicted)).size


def test_the_quick_picture_has_range_to_the_right_and_frequency_upwards():
    level = np.zeros((2, 100, 30))
    level[1, 60:, 20:] = LIVE_DB  # of the right ear: far, and of high frequency
    axes = 0.3 + 0.001 * np.arange(100), 1e3 * np.linspace(10, 80, 30)
    alone = quick_image({"predicted": level}, *axes)
    height, width = alone.shape[0], alone.shape[1]
    bright = (alone.astype(int).sum(axis=2) > 600) & (np.ptp(alone, axis=2) > 30)
    rows, columns = np.nonzero(bright)
    assert rows.min() > height / 2
    assert rows.max() < 0.75 * height
    assert columns.min() > 0.6 * width
    # Beside what was measured, twice as loud, the difference is blue there.
    both = quick_image({"measured": 2 * level, "predicted": level}, *axes).astype(int)
    assert both.shape[1] > 2.5 * width
    red, green, blue = both[:, 2 * both.shape[1] // 3 :].transpose(2, 0, 1)
    rows, _ = np.nonzero((blue > red + 60) & (blue > green + 20))
    assert len(rows)
    assert height / 2 < rows.min()
    assert rows.max() < 0.75 * height
