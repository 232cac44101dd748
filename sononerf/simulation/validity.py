# SPDX-License-Identifier: MIT
"""By how much an engine is known to be wrong, per frequency."""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from sononerf.scene.scene import Scene
from sononerf.simulation.engine import Engine
from sononerf.simulation.hybrid import Hybrid
from sononerf.simulation.reference.kirchhoff import Kirchhoff
from sononerf.simulation.solved import Solved

KA = (2.7, 4.3, 5.9, 7.5, 9.1, 10.7, 12.3, 15.6, 22.0)
"""Wavenumber times radius, at which the errors below were measured."""
RAYS_DB = (12.5, 9.6, 4.5, 1.5, 0.8, 0.6, 0.5, 0.4, 0.3)
"""Mean error (dB) of the rays over cells within 20 dB of a pose's loudest, ``three_spheres``
against exact multiple scattering: ``tools/benchmark.py exact``."""
KIRCHHOFF_DB = (9.5, 8.1, 7.2, 6.1, 5.2, 3.4, 1.8, 0.9, 0.6)
"""The same of physical optics."""
SOLVED_DB = 0.15
"""The same where the wave equation is solved: the equivalent sources against ``spheres``, and
``bem`` against ``spheres``."""


def expected_error_db(
    engine: Engine, scene: Scene, frequency: NDArray[np.float64]
) -> NDArray[np.float64] | None:
    r"""Return the mean error of an engine's levels that is to be expected at frequencies.

    What rays and physical optics leave out depends on ka, wavenumber times radius. It was measured
    on rigid spheres. A body of another shape counts as a sphere of its area,
    :math:`a = \sqrt{A / 4 \pi n}` with n bodies.

    Parameters
    ----------
    engine : Engine
        What simulates.
    scene : Scene
        What is ensonified.
    frequency : (F,) float64, Hz
        Of the spectrograms.

    Returns
    -------
    error : (F,) float64, dB, or None
        Over cells within 20 dB of the loudest of their pose. None where a material is not rigid:
        no exact solution is at hand.
    """
    if not all(material.rigid for material in scene.materials):
        return None
    if isinstance(engine, Solved):
        return np.full(len(frequency), SOLVED_DB)
    radius = math.sqrt(float(scene.mesh.area) / (4.0 * math.pi * max(scene.mesh.body_count, 1)))
    ka = 2.0 * math.pi * frequency / engine.hearing.speed_of_sound * radius
    measured = KIRCHHOFF_DB if isinstance(engine, Kirchhoff) else RAYS_DB
    error = np.interp(ka, KA, measured)
    if isinstance(engine, Hybrid):
        solved = engine.low.taper(frequency)
        error = solved * SOLVED_DB + (1.0 - solved) * error
    found: NDArray[np.float64] = error
    return found
