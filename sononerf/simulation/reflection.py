# SPDX-License-Identifier: MIT
"""How a surface reflects: a lobe about the mirror direction, a strength, a rest that goes on."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from sononerf.scene import Material

# Beyond this many standard deviations a lobe is 3e-4 of its middle (-70 dB) and left out.
REACH = 4.0


@dataclass(frozen=True, eq=False)
class Reflection:
    """A material at the frequencies of a simulation.

    Attributes
    ----------
    lobe_width : (F,) float64, rad
        Standard deviation of the lobe.
    strength : (F,) float64, 1
        Of what is heard of a hit.
    kept : (F,) float64, 1
        Of the pressure after a bounce.
    """

    lobe_width: NDArray[np.float64]
    strength: NDArray[np.float64]
    kept: NDArray[np.float64]


def reflection(material: Material, frequency: ArrayLike) -> Reflection:
    """Return a material's values at frequencies (F,) in Hz, straight over their logarithm."""
    wanted, nodes = np.log(np.asarray(frequency)), np.log(material.frequency)
    width, strength, kept = (
        np.interp(wanted, nodes, values)
        for values in (material.lobe_width, material.strength, material.reflection)
    )
    return Reflection(width, strength, kept)


def mirror(directions: NDArray[np.float64], normals: NDArray[np.float64]) -> NDArray[np.float64]:
    """Mirror directions about planes.

    Parameters
    ----------
    directions : (N, 3) float64
        Unit vectors towards the surface.
    normals : (N, 3) float64
        Unit normals; their sign does not matter.

    Returns
    -------
    mirrored : (N, 3) float64
        Unit vectors.
    """
    along = np.einsum("nd,nd->n", directions, normals)
    mirrored: NDArray[np.float64] = directions - (2.0 * along)[:, None] * normals
    return mirrored


def keep_outside(directions: NDArray[np.float64], flat: NDArray[np.float64]) -> NDArray[np.float64]:
    """Turn directions that run into the surface so far that they graze it.

    A mirror direction about a smooth normal may point into the flat triangle that was hit.

    Parameters
    ----------
    directions : (N, 3) float64
        Unit vectors.
    flat : (N, 3) float64
        Unit normals of the triangles, on the side of the ray.

    Returns
    -------
    directions : (N, 3) float64
        Unit vectors.
    """
    rise = np.einsum("nd,nd->n", directions, flat)
    lifted = directions + np.maximum(1e-4 - rise, 0.0)[:, None] * flat
    turned: NDArray[np.float64] = lifted / np.linalg.norm(lifted, axis=1, keepdims=True)
    return turned


def lobe_exponent(
    cosine: NDArray[np.float64], lobe_width: NDArray[np.float64]
) -> NDArray[np.float64]:
    """Logarithm of the lobe, ``-theta**2 / (2 w**2)``.

    Parameters
    ----------
    cosine : (N,) float64
        Of the angle theta between the mirror direction and that towards the listener.
    lobe_width : (F,) float64, rad
        Standard deviations.

    Returns
    -------
    exponent : (N, F) float64
        Zero in the mirror direction, falling away from it.
    """
    theta = np.arccos(np.clip(cosine, -1.0, 1.0))
    return -0.5 * np.square(theta)[:, None] / np.square(lobe_width)
