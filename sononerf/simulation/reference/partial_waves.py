# SPDX-License-Identifier: MIT
"""Partial waves: spherical functions, rotations and translations of their coefficients."""

from __future__ import annotations

import math

import numpy as np
from scipy.linalg import eigh_tridiagonal
from scipy.special import spherical_jn

from sononerf.array_types import Complexes, Floats, Ints


def log_outgoing(degree: int, argument: Complexes) -> tuple[Complexes, Complexes]:
    """Spherical Hankel functions of the second kind, as logarithms.

    The ratio of neighbours follows by the recurrence upwards, which is stable for them
    (DLMF 10.51.1); functions of degrees far above the argument do not overflow.

    Args:
        argument ((X,) complex128): Not zero.

    Returns:
        logarithm ((N + 1, X) complex128): Logarithm of the function, up to multiples of 2 pi j.
        slope ((N + 1, X) complex128): Derivative over function.
    """
    logarithm = np.zeros((degree + 1, len(argument)), dtype=np.complex128)
    slope = np.zeros_like(logarithm)
    logarithm[0] = np.log(1j / argument) - 1j * argument
    slope[0] = -1j - 1.0 / argument
    ratio = 1.0 / argument + 1j
    for n in range(1, degree + 1):
        logarithm[n] = logarithm[n - 1] + np.log(ratio)
        slope[n] = 1.0 / ratio - (n + 1) / argument
        ratio = (2 * n + 1) / argument - 1.0 / ratio
    return logarithm, slope


def legendre(degree: int, cosine: Floats) -> Floats:
    """Associated Legendre functions, normalised for spherical harmonics, with (-1)^m in them.

    Args:
        cosine (X,): Cosines of the polar angle.

    Returns:
        values (N + 1, N + 1, X): By order m, then by degree n; zero where n < m. Times exp(j m phi)
            they are orthonormal.
    """
    values = np.zeros((degree + 1, degree + 1, len(cosine)))
    sine = np.sqrt(np.maximum(1.0 - cosine**2, 0.0))
    values[0, 0] = math.sqrt(0.25 / math.pi)
    for m in range(1, degree + 1):
        values[m, m] = -math.sqrt((2 * m + 1) / (2 * m)) * sine * values[m - 1, m - 1]
    for n in range(1, degree + 1):
        below = np.arange(n)[:, None]
        values[:n, n] = np.sqrt((4 * n**2 - 1) / (n**2 - below**2)) * cosine * values[:n, n - 1]
        if n > 1:
            below = below[: n - 1]
            before = (2 * n + 1) / (2 * n - 3) * ((n - 1) ** 2 - below**2) / (n**2 - below**2)
            values[: n - 1, n] -= np.sqrt(before) * values[: n - 1, n - 2]
    return values


def harmonics(degree: int, directions: Floats) -> Complexes:
    """Orthonormal spherical harmonics.

    Args:
        directions (X, 3): Unit vectors.

    Returns:
        values (((N + 1)^2, X) complex128): At row n (n + 1) + m.
    """
    table = legendre(degree, np.clip(directions[:, 2], -1.0, 1.0))
    azimuth = np.arctan2(directions[:, 1], directions[:, 0])
    turn = np.exp(1j * np.arange(degree + 1)[:, None] * azimuth)
    values = np.zeros(((degree + 1) ** 2, len(directions)), dtype=np.complex128)
    for n in range(degree + 1):
        right = table[: n + 1, n] * turn[: n + 1]
        middle = n * (n + 1)
        values[middle : middle + n + 1] = right
        sign = np.where(np.arange(1, n + 1) % 2, -1.0, 1.0)[:, None]
        values[middle - n : middle] = (sign * right[1:].conj())[::-1]
    return values


def wigner(degree: int, angles: list[float]) -> list[Floats]:
    """Matrices of one degree n that turn spherical harmonics about y.

    Args:
        angles (list of float, rad): Angles of the turns.

    Returns:
        matrices (list of (2 n + 1, 2 n + 1) float64): Matrices of exp(-j angle J_y), orders
            ascending.
    """
    m = np.arange(-degree, degree + 1)
    off = 0.5 * np.sqrt(degree * (degree + 1) - m[:-1] * (m[:-1] + 1.0))
    values, vectors = eigh_tridiagonal(np.zeros(len(m)), off)
    # J_y is J_x, which is real, turned by a quarter about z.
    turned = (1j ** (-(m % 4)))[:, None] * vectors
    values = np.round(values)
    return [
        np.ascontiguousarray(((turned * np.exp(-1j * angle * values)) @ turned.conj().T).real)
        for angle in angles
    ]


def slopes(size: complex, log_h: Complexes) -> Complexes:
    """Return derivatives of Bessel functions times Hankel functions (N + 1,) at one argument."""
    n = np.arange(len(log_h))
    product: Complexes = 1j * n / ((2 * n + 1) * size**2)  # their limit far above the argument
    plain = log_h[:, 0].real < 600.0
    product[plain] = spherical_jn(n[plain], size, derivative=True) * np.exp(log_h[plain, 0])
    return product


def seen_from(away: Floats, degree: int) -> tuple[Floats, Complexes]:
    """Distance (P,) of places from a centre, and the harmonics ((N + 1)^2, P) towards them."""
    distance = np.linalg.norm(away, axis=1)
    return distance, harmonics(degree, away / distance[:, None])


def _orders(degree: int) -> Ints:
    """Order m of each row of waves."""
    return np.concatenate([np.arange(-n, n + 1) for n in range(degree + 1)])


def _degree(waves: Complexes) -> int:
    return math.isqrt(len(waves)) - 1


def into_axis(waves: Complexes, azimuth: float, turns: list[Floats]) -> Complexes:
    """Turn waves into the frame whose z is the axis."""
    turned = np.exp(1j * azimuth * _orders(_degree(waves)))[:, None] * waves
    return _turned(turned, turns, back=False)


def out_of_axis(waves: Complexes, azimuth: float, turns: list[Floats]) -> Complexes:
    """Turn waves back from the frame of an axis; see :func:`into_axis`."""
    turned = _turned(waves, turns, back=True)
    turned *= np.exp(-1j * azimuth * _orders(_degree(waves)))[:, None]
    return turned


def _turned(waves: Complexes, turns: list[Floats], *, back: bool) -> Complexes:
    turned = np.zeros_like(waves)
    for n in range(_degree(waves) + 1):
        rows = slice(n**2, (n + 1) ** 2)
        matrix = turns[n] if back else turns[n].T
        # Real and imaginary parts side by side: the matrix is real.
        np.matmul(matrix, waves[rows].view(np.float64), out=turned[rows].view(np.float64))
    return turned


def mirror(waves: Complexes) -> None:
    """Turn z round, up to the sign of the order, which translations along z leave alone."""
    for n in range(1, _degree(waves) + 1, 2):
        waves[n**2 : (n + 1) ** 2] *= -1.0


def move(moves: list[Complexes], waves: Complexes, wanted: int) -> Complexes:
    """Translate waves of one sphere along the axis to those that they cause on another."""
    given = _degree(waves)
    moved = np.zeros(((wanted + 1) ** 2, waves.shape[1]), dtype=np.complex128)
    for m, matrix in enumerate(moves):
        source, target = np.arange(m, given + 1), np.arange(m, wanted + 1)
        for order in {m, -m}:
            moved[target * (target + 1) + order] = matrix @ waves[source * (source + 1) + order]
    return moved


def inner_product(one: Complexes, two: Complexes) -> Complexes:
    """Scalar product (P,) of the columns of two arrays (K, P)."""
    product: Complexes = np.einsum("kp,kp->p", one.conj(), two)
    return product
