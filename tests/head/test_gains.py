# SPDX-License-Identifier: MIT
import numpy as np
import pytest

from sononerf.head.gains import SPEED, ear, piston
from sononerf.settings.schema import EarSettings


def ring(*angles_deg):
    """Directions in the horizontal plane, (1, A, 3)."""
    angle = np.radians(angles_deg)
    return np.stack([np.cos(angle), np.sin(angle), np.zeros_like(angle)], axis=-1)[None]


@pytest.mark.parametrize(
    ("ka", "degrees", "expected"),
    # 2 J1(x) / x at x = ka sin(angle): tables of Bessel functions.
    [(2.0, 90.0, 0.5767248), (2.0, 30.0, 2 * 0.4400506), (5.0, 90.0, 2 * 0.3275791 / 5)],
)
def test_a_piston_in_a_baffle(ka, degrees, expected):
    frequency = np.array([40e3])
    radius = ka * SPEED / (2 * np.pi * 40e3)
    gain = piston(ring(degrees), radius, frequency)[0, 0, 0]
    fade = (1 + np.cos(np.radians(degrees))) / 2
    assert gain == pytest.approx(fade * expected, rel=1e-5)


def test_a_piston_is_whole_ahead_silent_behind_and_alike_without_a_radius():
    frequency = np.array([20e3, 80e3])
    np.testing.assert_allclose(piston(ring(0.0, 180.0), 0.003, frequency)[:, 0], [[1, 0], [1, 0]])
    assert (piston(ring(0.0, 90.0, 180.0), 0.0, frequency) == 1.0).all()


@pytest.mark.parametrize(("side", "best"), [(1.0, 25.0), (0.0, 0.0), (-1.0, -25.0)])
def test_an_ear_hears_best_on_its_side(side, best):
    angles = np.arange(-180.0, 180.0, 5.0)
    head = EarSettings(elevation_deg=0.0)
    gain = ear(ring(*angles), side, head, np.array([20e3]))
    assert angles[gain[0, 0].argmax()] == best
