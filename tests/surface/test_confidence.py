# SPDX-License-Identifier: MIT
import numpy as np

from sononerf.surface.mesh_files import MANY_POSES, confidence_colours, linear_light


def test_colours_brighten_evenly_from_grey_to_yellow():
    colours = confidence_colours([0, 1, 3, 10, 30, MANY_POSES, 10 * MANY_POSES])
    assert ((colours >= 0) & (colours <= 1)).all()
    assert np.ptp(colours[0]) < 0.05
    assert colours[-2, 0] > 0.85
    assert colours[-2, 2] < 0.7
    np.testing.assert_array_equal(colours[-2], colours[-1])
    # The eye's lightness, CIE L*, from relative luminance: a rule that the map was not made with.
    even = np.expm1(np.linspace(0, 1, 9) * np.log1p(MANY_POSES))
    luminance = linear_light(confidence_colours(even)) @ [0.2126, 0.7152, 0.0722]
    lightness = 116 * np.cbrt(luminance) - 16
    steps = np.diff(lightness)
    assert steps.min() > 0.8 * steps.mean()
    assert steps.max() < 1.2 * steps.mean()
    assert lightness[0] < 30
    assert lightness[-1] > 85
