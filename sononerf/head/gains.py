# SPDX-License-Identifier: MIT
"""Models of directivity: a piston, a bat-like ear, and the same gain in all directions.

Azimuth counts from straight ahead, positive to the left; elevation is positive up.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from scipy.special import j1

from sononerf.settings.schema import EarSettings

SPEED = 343.0  # m/s; the beam's width follows it so weakly that temperature is left out
WIDTH_FREQUENCY = 50e3  # Hz, where an ear is as wide as its setting says
NOTCH_MIDDLE = 60e3  # Hz, at elevation 0
NOTCH_RISE = 30e3  # Hz, from elevation 0 to straight up
NOTCH_WIDTH = 8e3  # Hz, standard deviation

Array = NDArray[np.float64]


def piston(directions: Array, radius: float, frequency: Array) -> Array:
    r"""Gain of a piston in a small head that looks ahead.

    .. math:: |2 J_1(ka \sin\theta) / (ka \sin\theta)| (1 + \cos\theta) / 2

    with the radius a. The first factor is a circular piston in an infinite baffle [1]_; the second
    makes it fade towards its back, as a source without a baffle does.

    Args:
        directions (L, A, 3): Unit vectors, head frame.
        radius (m): Of the piston; 0 is the same in all directions.
        frequency ((F,), Hz): Any.

    Returns:
        gain (F, L, A): 1 straight ahead.

    References:
        .. [1] L. L. Beranek, T. J. Mellow, Acoustics: Sound Fields and Transducers, 2012, 13.7.
    """
    if radius == 0.0:
        return np.ones((len(frequency), *directions.shape[:2]))
    forward = directions[..., 0]
    sine = np.sqrt(np.clip(1.0 - forward**2, 0.0, None))
    x = (2.0 * np.pi * radius / SPEED) * frequency[:, None, None] * sine
    baffled = np.abs(np.where(x > 1e-6, 2.0 * j1(x) / np.where(x > 1e-6, x, 1.0), 1.0))
    return np.asarray(baffled * (1.0 + forward) / 2.0)


def ear(directions: Array, side: float, settings: EarSettings, frequency: Array) -> Array:
    """Gain of a synthetic, bat-like ear.

    It hears best towards its axis, as a Gaussian of the angle from it whose width falls with the
    square root of frequency (``width_deg`` at 50 kHz). A spectral notch rises from 30 kHz (straight
    down) over 60 kHz to 90 kHz (straight up), so that elevation can be told from the spectrum.

    Args:
        directions (L, A, 3): Unit vectors, head frame; elevation is that of the row.
        side: 1 for an ear that looks to the left, -1 to the right, 0 straight ahead.
        settings: Axis, width and depth of the notch.
        frequency ((F,), Hz): Above zero.

    Returns:
        gain (F, L, A): At most 1.
    """
    azimuth, elevation = np.radians(side * settings.azimuth_deg), np.radians(settings.elevation_deg)
    axis = (
        np.cos(elevation) * np.cos(azimuth),
        np.cos(elevation) * np.sin(azimuth),
        np.sin(elevation),
    )
    angle = np.arccos(np.clip(directions @ np.asarray(axis), -1.0, 1.0))
    width = np.radians(settings.width_deg) * np.sqrt(WIDTH_FREQUENCY / frequency)
    gain = np.exp(-0.5 * (angle / width[:, None, None]) ** 2)
    heights = np.arcsin(np.clip(directions[:, 0, 2], -1.0, 1.0))
    notch_at = NOTCH_MIDDLE + NOTCH_RISE * heights / (np.pi / 2.0)
    off = (frequency[:, None] - notch_at) / NOTCH_WIDTH  # (F, L)
    notch = 1.0 - settings.notch_depth * np.exp(-0.5 * off**2)
    return np.asarray(gain * notch[:, :, None])
