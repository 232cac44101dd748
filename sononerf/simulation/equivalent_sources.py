# SPDX-License-Identifier: MIT
"""The equations of equivalent sources at one frequency; see :mod:`sononerf.simulation.low_band`."""

from __future__ import annotations

import math

import numpy as np
import scipy.linalg
from numpy.typing import NDArray

from sononerf.errors import NumericalError
from sononerf.numerics import Floats

POINTS = 1.5
"""Points of the surface per source where the boundary condition holds; 2 gave the same error."""
DEPTH = 1.5
"""Depth of a source below the surface, in distances between sources. Deeper sources are more exact
on smooth meshes, but on reconstructed meshes the equations become ill-conditioned."""
INSIDE = 0.3
"""Greatest depth of a source, as a fraction of the thickness of the body there."""
REGULARISATION = 1e-8
"""Added to the normal equations, as a fraction of their mean diagonal. On a reconstructed mesh less
of it lets the response ring; more of it loses accuracy."""
DIPOLE = 0.1
"""Dipole moment of a source over that which makes it silent towards its back. 0.03 leaves some of
the resonances; 1 makes the error half as great again."""
CHECKS = 200
"""Points of the surface that are left out of the solution and give its error."""


class Equations:
    """The equations of one frequency, factorised.

    In: spacing (m), wavenumber (1/m).
    """

    @property
    def bytes(self) -> int:
        """Memory of the matrices."""
        return self._adjoint.nbytes + self._factor.nbytes + self._checks.nbytes

    def __init__(
        self,
        surface: tuple[Floats, Floats, Floats],
        count: int,
        spacing: float,
        wavenumber: complex,
    ) -> None:
        points, normals, thickness = surface
        depth = np.minimum(DEPTH * spacing, INSIDE * thickness[:count])
        self.places = points[:count] - depth[:, None] * normals[:count]
        self._asked = round(POINTS * count)
        # The last points stand in the gaps between all others.
        self.chosen = np.r_[: self._asked, len(points) - CHECKS : len(points)]
        self.points, self.normals = points[self.chosen], normals[self.chosen]
        self.axes = normals[:count]
        matrix = _slopes(self.points, self.normals, self.places, wavenumber, self.axes)
        self._checks = matrix[self._asked :]
        self._adjoint = np.ascontiguousarray(matrix[: self._asked].T).conj()
        # The squares of the equations need double precision, their solutions do not.
        used = np.asfortranarray(matrix[: self._asked], dtype=np.complex128)
        normal = scipy.linalg.blas.zherk(1.0, used, trans=2, lower=1)
        diagonal = np.einsum("ii->i", normal)
        diagonal += REGULARISATION * float(diagonal.real.mean())
        try:
            factor, _ = scipy.linalg.cho_factor(
                normal, lower=True, overwrite_a=True, check_finite=False
            )
            self._factor = factor.astype(np.complex64)
        except scipy.linalg.LinAlgError as error:
            raise NumericalError(
                f"the equivalent sources at wavenumber {wavenumber.real:.3g} / m cannot be solved "
                "for; set simulation.engine=rays"
            ) from error

    def solve(self, incident: NDArray[np.complex64]) -> NDArray[np.complex64]:
        """Return the sources' strengths (M, P) for normal slopes of pressure (N, P)."""
        wanted = self._adjoint @ -incident[: self._asked]
        return scipy.linalg.cho_solve(
            (self._factor, True), wanted, overwrite_b=True, check_finite=False
        )

    def error(self, incident: NDArray[np.complex64], strength: NDArray[np.complex64]) -> float:
        """Return what is left of the normal slope at the points that were left out, relative."""
        arriving = incident[self._asked :]
        left = self._checks @ strength + arriving
        return float(np.linalg.norm(left) / np.linalg.norm(arriving))


def _slopes(
    points: Floats, normals: Floats, places: Floats, wavenumber: complex, axes: Floats | None = None
) -> NDArray[np.complex64]:
    r"""Return :math:`\partial_n` of pressure at points (N, 3) for sources (M, 3).

    The pressure is :math:`e^{-j k r} / 4 \pi r`. Where axes (M, 3) are given, each source has a
    dipole too, which makes it loudest along its axis; see :class:`LowBand`.
    """
    square = _squares(points, places)
    distance = np.sqrt(square)
    across = np.einsum("nd,nd->n", points, normals)[:, None] - normals @ places.T
    slope = _turned(distance, wavenumber)
    slope /= (square * distance).astype(np.float32)
    across = across.astype(np.float32)
    grown = (1.0 + 1j * wavenumber * distance).astype(np.complex64)
    if axes is None:
        slope *= -across * grown
        return slope
    along = points @ axes.T - np.einsum("md,md->m", places, axes)
    both = along.astype(np.float32) * across
    gradient = (normals @ axes.T).astype(np.float32) - both * (3.0 / square).astype(np.float32)
    dipole = grown * gradient
    dipole += both * np.complex64(wavenumber**2)
    dipole *= np.complex64(-1j * DIPOLE / wavenumber.real)
    dipole -= across * grown
    slope *= dipole
    return slope


def waves(
    points: Floats, places: Floats, wavenumber: complex, axes: Floats
) -> NDArray[np.complex64]:
    r"""Return the pressure at points (N, 3) of sources (M, 3) with dipoles; see :func:`_slopes`."""
    distance = np.sqrt(_squares(points, places))
    wave = _turned(distance, wavenumber)
    wave /= distance.astype(np.float32)
    cosine = (points @ axes.T - np.einsum("md,md->m", places, axes)) / distance
    grown = 1j * wavenumber + 1.0 / distance
    wave *= (1.0 - 1j * DIPOLE / wavenumber.real * cosine * grown).astype(np.complex64)
    return wave


def _turned(distance: Floats, wavenumber: complex) -> NDArray[np.complex64]:
    r"""Return :math:`e^{-j k r} / 4 \pi` at distances (N, M); phases keep their full precision."""
    turns = distance * (wavenumber.real / (2.0 * math.pi))
    turns -= np.rint(turns)
    phase = turns.astype(np.float32)
    phase *= np.float32(-2.0 * math.pi)
    size = np.exp((wavenumber.imag * distance).astype(np.float32))
    size *= np.float32(0.25 / math.pi)
    wave = np.zeros(distance.shape, dtype=np.complex64)
    np.multiply(size, np.cos(phase), out=wave.real)
    np.multiply(size, np.sin(phase), out=wave.imag)
    return wave


def _squares(points: Floats, places: Floats) -> Floats:
    """Return squared distances (N, M), m²; products suffice, for coordinates are as small."""
    square = np.square(points).sum(axis=1)[:, None] + np.square(places).sum(axis=1)
    square -= 2.0 * points @ places.T
    return square


def arriving(
    points: Floats, normals: Floats, emitters: Floats, wavenumber: complex
) -> NDArray[np.complex64]:
    r"""Return :math:`\partial_n e^{-j k r} / r` at points (N, 3) for emitters (P, 3)."""
    return np.float32(4.0 * math.pi) * _slopes(points, normals, emitters, wavenumber)
