# SPDX-License-Identifier: MIT
"""The engine for rigid bodies of any shape: a boundary-element solution of the wave equation."""

from __future__ import annotations

import logging
import math
from typing import Any

import numpy as np
from scipy.linalg import lu_factor, lu_solve

from sononerf.array_types import Complexes, Floats
from sononerf.errors import NumericalError, ResourceError
from sononerf.memory import available_memory
from sononerf.scene.scene import Scene
from sononerf.simulation.hearing import Hearing
from sononerf.simulation.reference.boundary_mesh import (
    check_apart,
    closed_bodies,
    expected_vertices,
    suited,
)
from sononerf.simulation.reference.boundary_near import Panels
from sononerf.simulation.reference.boundary_operators import Operators, coupling
from sononerf.simulation.solved import LONGEST, Heads, Solved

logger = logging.getLogger("sononerf")

STEP = math.sqrt(2.0)  # between the highest frequencies of two meshes
FEWEST = 200  # vertices; a coarser mesh saves no time
WAVES = 1 << 22  # incident waves at a time: poses times points
COPIES = 2.2  # matrices in memory at a time, with the single precision of real and imaginary parts
# Measured on one core: seconds per square of a thousand unknowns to fill the matrix, and per cube
# to factorise it.
FILLING, FACTORISING = 0.4, 0.035


class Boundary(Solved):
    r"""Echoes by boundary elements, of rigid bodies of any shape.

    With :math:`G = e^{-jkR} / 4 \pi R` and the normal :math:`n` out of the bodies the pressure on
    their surface obeys Burton and Miller's equation [1]_

    .. math:: \frac12 p - \int p \frac{\partial G}{\partial n'} dS'
        - \beta \frac{\partial}{\partial n} \int p \frac{\partial G}{\partial n'} dS'
        = p_i + \beta \frac{\partial p_i}{\partial n}, \qquad \beta = -j / k

    which has one solution at every frequency; the sign of :math:`\beta` belongs to
    :math:`e^{j \omega t}` [2]_. Pressure is linear between the vertices of a mesh, the method is
    Galerkin's, see :class:`Operators`. The matrix is dense and is factorised once per frequency,
    for all poses. Each octave below the highest frequency has two meshes of its own, see
    :func:`suited`.

    Creeping waves, shadows and reflections of any number are in it. Bodies must be closed, lie
    apart and be rigid; of a material nothing counts, and the engine says so. A body's sharp edges
    and its flat triangles are taken as they are: of a sphere that is given as an inscribed
    polyhedron, the echo comes later by twice the depth of the facets.

    Args:
        frequency_max (Hz): Frequency at which the response has fallen to zero.

    References:
        .. [1] A. J. Burton and G. F. Miller, "The application of integral equation methods to the
           numerical solution of some exterior boundary-value problems", Proceedings of the Royal
           Society A 323, 1971.
        .. [2] S. Marburg, "The Burton and Miller method: unlocking another mystery of its coupling
           parameter", Journal of Computational Acoustics 24, 2016.
    """

    def __init__(
        self,
        scene: Scene,
        hearing: Hearing,
        *,
        frequency_max: float,
        edges_per_wavelength: float = 5.0,
    ) -> None:
        if not all(material.rigid for material in scene.materials):
            logger.warning(
                "simulation.engine=bem takes surfaces as smooth and rigid; roughness, lobes and "
                "strength are left out, simulation.engine=rays has them"
            )
        self.edges_per_wavelength = edges_per_wavelength
        self._bodies = closed_bodies(scene.mesh)
        super().__init__(scene, hearing, frequency_max=frequency_max)
        self._level: tuple[float, Operators] | None = None
        self._unknowns = self._expected(self.frequency_max)
        self._check_size()
        panels = self._panels(self.frequency_max)
        self._unknowns = len(panels.vertices)
        self._check_size()

    def __getstate__(self) -> dict[str, Any]:
        return {**super().__getstate__(), "_level": None}

    @property
    def unknowns(self) -> int:
        """Vertices of the finest mesh."""
        return self._unknowns

    def estimate(self, poses: int) -> tuple[float, float]:
        """Return the memory (bytes) and the time (s) on one core for a number of poses."""
        del poses  # the matrix outweighs them
        level = self.frequency_max / STEP ** np.floor(
            np.log(self.frequency_max / self.frequency) / math.log(STEP)
        )
        thousands = np.maximum(self._unknowns * (level / self.frequency_max) ** 2, FEWEST) / 1e3
        seconds = FILLING * thousands**2 + FACTORISING * thousands**3
        return COPIES * 8.0 * self._unknowns**2, float(seconds.sum())

    def respond(self, wavenumber: complex, poses: Heads) -> Complexes:
        """Scattered pressure at the ears; see :meth:`Solved.respond`."""
        k = complex(wavenumber)
        operators = self._operators(k)
        panels = operators.panels
        # Transposed, LAPACK takes the matrix as it lies in memory.
        factors = lu_factor(operators.matrix(k).T, overwrite_a=True, check_finite=False)
        found = np.zeros((len(poses), poses.ears.shape[1]), dtype=np.complex128)
        chunk = max(1, WAVES // len(panels.points))
        for start in range(0, len(poses), chunk):
            some = poses[start : start + chunk]
            load = excitation(panels, k, some.emitters, some.beam(panels.points))
            solved = lu_solve(factors, load.astype(np.complex64), trans=1, check_finite=False)
            pressure = (panels.halves @ solved).T
            for ear in range(found.shape[1]):
                gain = some.gain(ear, panels.points)
                heard = radiated(panels, k, pressure * gain, some.ears[:, ear])
                found[start : start + chunk, ear] = heard
        if not np.isfinite(found).all():
            raise NumericalError(
                f"simulation.engine=bem finds no finite pressure at k = {k:.4g} 1/m; look for "
                "doubled or flat triangles in the mesh"
            )
        return found

    def _operators(self, wavenumber: complex) -> Operators:
        frequency = wavenumber.real * self.hearing.speed_of_sound / (2.0 * math.pi)
        highest = self.frequency_max
        while frequency <= highest / STEP and self._expected(highest / STEP) >= FEWEST:
            highest /= STEP
        if self._level is None or self._level[0] != highest:
            self._level = highest, Operators(self._panels(highest))
        return self._level[1]

    def _edge(self, frequency: float) -> float:
        return self.hearing.speed_of_sound / (frequency * self.edges_per_wavelength)

    def _expected(self, frequency: float) -> int:
        return expected_vertices(self._bodies.area, self._edge(frequency))

    def _panels(self, frequency: float) -> Panels:
        mesh = suited(self._bodies, self._edge(frequency))
        check_apart(mesh)
        return Panels.of(mesh.vertices, mesh.faces)

    def _check_size(self) -> None:
        memory, seconds = self.estimate(1)
        free = available_memory()
        share = 1.0
        if free is not None:
            share = min(share, (free / memory) ** 0.25)  # unknowns grow as frequency squared
        share = min(share, (LONGEST / seconds) ** (1.0 / 6.0))
        if share < 1.0:
            able = math.floor(share * self.frequency_max / 1e3)
            raise ResourceError(
                f"simulation.engine=bem needs {self._unknowns:,} unknowns up to "
                f"{self.frequency_max / 1e3:.3g} kHz ({memory / 1e9:.3g} GB, "
                f"{seconds / 3600.0:.2g} hours); it can do this scene up to {able} kHz: set "
                f"simulation.frequency_max={able}e3"
            )


def excitation(
    panels: Panels,
    wavenumber: complex,
    emitters: Floats,
    beam: Floats,
) -> Complexes:
    """Return the right-hand sides (V, P), m: the incident waves and their normal derivatives.

    Args:
        wavenumber (1/m): Its imaginary part is not positive.
        emitters ((P, 3), m): Points that send e^{-jkr} / r.
        beam (P, Q): Their gains towards the panels' points.
    """
    distance, cosine = _ways(panels, emitters)
    slope = coupling(wavenumber) * (1j * wavenumber + 1.0 / distance) * cosine
    incident = beam * np.exp(-1j * wavenumber * distance) / distance
    load: Complexes = panels.halves.T @ (incident * (panels.weights + slope)).T
    return load


def radiated(
    panels: Panels,
    wavenumber: complex,
    pressure: Complexes,
    ears: Floats,
) -> Complexes:
    """Return the scattered pressure at ears.

    Args:
        wavenumber (1/m): Its imaginary part is not positive.
        pressure ((P, Q) complex): On the panels' points, for each pose; the ear's gain included.
        ears ((P, 3), m): One for each pose.

    Returns:
        heard ((P,) complex128): The integral of the pressure times the normal derivative of
            e^{-jkr} / 4 pi r.
    """
    distance, cosine = _ways(panels, ears)
    kernel = (1j * wavenumber + 1.0 / distance) * np.exp(-1j * wavenumber * distance) / distance
    heard: Complexes = (kernel * cosine * pressure).sum(axis=1) / (4.0 * np.pi)
    return heard


def _ways(panels: Panels, places: Floats) -> tuple[Floats, Floats]:
    """Distances (P, Q), m, and cosines from the normals towards places, times areas (P, Q), m2."""
    away = places[:, None] - panels.points
    distance = np.sqrt(np.einsum("pqd,pqd->pq", away, away))
    return distance, np.einsum("pqd,qd->pq", away, panels.vectors) / distance
