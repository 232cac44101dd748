# SPDX-License-Identifier: MIT
"""Colours for the number of poses that heard each place of a surface."""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike, NDArray

# So many poses and more have the brightest colour.
MANY_POSES = 100
# Dark grey and bright yellow in OKLab; on the line between the two, equal steps look equal.
FEW_COLOUR, MANY_COLOUR = (0.34, 0.0, -0.01), (0.93, -0.02, 0.15)


def confidence_colours(poses: ArrayLike) -> NDArray[np.float64]:
    """Colour numbers of poses: dark grey for none, bright yellow for a hundred and more.

    Steps are even to the eye (a straight line in OKLab [1]_) over the logarithm of one plus the
    number, and the ends are the same for every mesh, so that pictures can be compared.

    Parameters
    ----------
    poses : (N,) int
        Zero or more.

    Returns
    -------
    colours : (N, 3) float
        sRGB, 0 to 1.

    References
    ----------
    .. [1] B. Ottosson, "A perceptual color space for image processing", 2020.
    """
    counts = np.asarray(poses, dtype=np.float64)
    share = np.clip(np.log1p(counts) / np.log1p(MANY_POSES), 0, 1)[..., None]
    few, many = np.asarray(FEW_COLOUR), np.asarray(MANY_COLOUR)
    lightness, a, b = np.moveaxis(few + share * (many - few), -1, 0)
    long = (lightness + 0.3963377774 * a + 0.2158037573 * b) ** 3
    medium = (lightness - 0.1055613458 * a - 0.0638541728 * b) ** 3
    short = (lightness - 0.0894841775 * a - 1.2914855480 * b) ** 3
    linear = np.stack(
        [
            4.0767416621 * long - 3.3077115913 * medium + 0.2309699292 * short,
            -1.2684380046 * long + 2.6097574011 * medium - 0.3413193965 * short,
            -0.0041960863 * long - 0.7034186147 * medium + 1.7076147010 * short,
        ],
        axis=-1,
    ).clip(0, 1)
    colours: NDArray[np.float64] = np.where(
        linear <= 0.0031308, 12.92 * linear, 1.055 * linear ** (1 / 2.4) - 0.055
    )
    return colours


def linear_light(colours: ArrayLike) -> NDArray[np.float64]:
    """Turn sRGB colours (..., 3), 0 to 1, into linear light, as glTF has them."""
    given = np.asarray(colours, dtype=np.float64)
    light: NDArray[np.float64] = np.where(
        given <= 0.04045, given / 12.92, ((given + 0.055) / 1.055) ** 2.4
    )
    return light
