# SPDX-License-Identifier: MIT
"""The stages of a refinement, from coarse to fine; lengths in shortest wavelengths."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal


@dataclass(frozen=True)
class Stage:
    """One stage; lengths in the shortest wavelength of the analysed band.

    Attributes
    ----------
    smoothing : float
        Length over which steps are smoothed.
    edge : float
        Of the triangles.
    blur : float
        Of the signed distance before the stage.
    rate : float
        Length of the first steps, smoothing lengths.
    steps : int
        Of descent.
    beyond : {"none", "trace", "keep", "simulate"}
        What is added to the first bounce by physical optics: nothing; the power of later bounces,
        traced off the surface that the stage starts from, or those that were traced last; or the
        correction by the simulator, see :mod:`sononerf.surface.refine.correction`.
    """

    smoothing: float
    edge: float
    blur: float
    rate: float
    steps: int
    beyond: Literal["none", "trace", "keep", "simulate"]


STAGES = (
    Stage(smoothing=2.4, edge=0.8, blur=1.2, rate=0.08, steps=40, beyond="none"),
    Stage(smoothing=2.4, edge=0.8, blur=0.6, rate=0.08, steps=30, beyond="trace"),
    Stage(smoothing=2.0, edge=0.8, blur=0.6, rate=0.06, steps=30, beyond="keep"),
    Stage(smoothing=1.5, edge=0.7, blur=0.4, rate=0.04, steps=30, beyond="trace"),
    Stage(smoothing=1.0, edge=0.6, blur=0.2, rate=0.02, steps=30, beyond="keep"),
    Stage(smoothing=0.7, edge=0.5, blur=0.0, rate=0.02, steps=40, beyond="simulate"),
)
SHARP = 0.5
"""Edge of the triangles where the surface is not blurred, shortest wavelengths. The first stage is
done both blurred and sharp, and the surface that explains the validation poses better goes on.
Blurring takes dents and necks away; it also takes edges, sheets and wires away."""
