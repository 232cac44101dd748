# SPDX-License-Identifier: MIT
"""The picture of an import shows poses and each of the first pings."""

from __future__ import annotations

import io

import numpy as np
import pytest
from PIL import Image

from sononerf.geometry.poses import sphere_poses
from sononerf.report.pictures.ping_picture import pings_png


@pytest.mark.parametrize(("pings", "receivers"), [(1, 1), (3, 2)])
def test_a_row_for_each_ping(pings, receivers):
    rng = np.random.default_rng(0)
    poses = sphere_poses(9, radius=0.4, aim_jitter=0.1, generator=rng)

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
