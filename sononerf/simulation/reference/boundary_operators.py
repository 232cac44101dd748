# SPDX-License-Identifier: MIT
"""The integral operators of the boundary-element engine, for all frequencies.

Pressure is linear between the vertices. Both operators are Galerkin's. Maue's formula gives the
normal derivative of the double layer from the kernel of the single layer alone [1]_ [2]_. The
quadrature points of triangles are the middles of their edges; near pairs are corrected.

References:
    .. [1] A.-W. Maue, "Zur Formulierung eines allgemeinen Beugungsproblems durch eine
       Integralgleichung", Zeitschrift für Physik 126, 1949.
    .. [2] J.-C. Nédélec, "Integral equations with non integrable kernels", Integral Equations and
       Operator Theory 5, 1982.
"""

from __future__ import annotations

import warnings

import numpy as np
import torch
from numpy.typing import NDArray
from scipy.sparse import coo_array, csr_array, hstack

from sononerf.simulation.reference.boundary_near import Panels, corrections

BLOCK = 1 << 21  # entries of the kernel at a time


class Operators:
    """The matrix of Burton and Miller's equation on a surface, for any wavenumber.

    Attributes:
        panels: The surface.
    """

    def __init__(self, panels: Panels) -> None:
        self.panels = panels
        self._halves = panels.halves
        self._mass = panels.mass
        self._near = corrections(panels)
        self._curls = panels.curls

    def matrix(self, wavenumber: complex) -> NDArray[np.complex64]:
        r"""Return :math:`\frac12 M - D - \beta H` (V, V), m2, with :math:`\beta = -j / k`.

        Args:
            wavenumber (1/m): Its imaginary part is zero or less.
        """
        k = complex(wavenumber)
        beta = coupling(k)
        matrix = self._far(k, beta)
        h0, h2, h4, d0, d2 = self._near
        near = beta * (h0 + k**2 * h2 + k**4 * h4) + (d0 + k**2 * d2)
        sparse = coo_array(0.5 * self._mass - near / (4.0 * np.pi))
        matrix[sparse.row, sparse.col] += sparse.data
        return matrix

    def _far(self, k: complex, beta: complex) -> NDArray[np.complex64]:
        panels = self.panels
        count, vertices = len(panels.points), len(panels.vertices)
        middle = panels.points.mean(axis=0)
        points = torch.from_numpy((panels.points - middle).astype(np.float32))
        vectors = torch.from_numpy(panels.vectors.astype(np.float32))
        weights = torch.from_numpy(panels.weights.astype(np.float32))
        halves, curls = _torch(self._halves.T), _torch(_stacked(self._curls).T)
        found = torch.zeros(vertices, 2, vertices)  # real parts, then imaginary ones
        rows = max(64, BLOCK // count)
        for start in range(0, count, rows):
            some = slice(start, min(count, start + rows))
            green, layer = _kernels(points, vectors, weights, some, k, beta)
            _add(found, [self._halves[some]], torch.sparse.mm(halves, layer))
            _add(found, [curl[some] for curl in self._curls], torch.sparse.mm(curls, green))
        found /= 4.0 * np.pi
        return torch.complex(found[:, 0], found[:, 1]).numpy()


def _kernels(
    points: torch.Tensor,
    vectors: torch.Tensor,
    weights: torch.Tensor,
    some: slice,
    k: complex,
    beta: complex,
) -> tuple[torch.Tensor, torch.Tensor]:
    """Return the factors of the curls and of the values of the pressure (Q, 2 b)."""
    here = points[some]
    width = len(here)
    away = [here[:, axis] - points[:, axis, None] for axis in range(3)]  # (Q, b)
    square = away[0] ** 2
    square.addcmul_(away[1], away[1]).addcmul_(away[2], away[2])
    itself = torch.arange(some.start, some.stop), torch.arange(width)
    square[itself] = 1.0
    inverse = square.rsqrt_()
    distance = inverse.reciprocal()
    phase = distance * k.real
    size = inverse * torch.exp(distance * k.imag) if k.imag else inverse
    real, imaginary = torch.cos(phase).mul_(size), torch.sin(phase).mul_(size).neg_()
    real[itself], imaginary[itself] = k.imag, -k.real
    height = sum(away[axis] * vectors[:, axis, None] for axis in range(3))
    height *= weights[some] * inverse * inverse
    height[itself] = 0.0
    # Minus the double layer: height (1 + j k R) e^{-jkR} / R.
    one = distance.mul(-k.imag).add_(1.0).mul_(height)
    other = phase.mul_(height)
    square_term = -beta * k**2
    cosine = vectors @ vectors[some].T
    layer = torch.zeros(len(points), 2 * width)
    layer[:, :width] = other * imaginary - one * real
    layer[:, width:] = -(other * real + one * imaginary)
    for scale, part in ((square_term, real), (1j * square_term, imaginary)):
        part = part * cosine
        layer[:, :width].add_(part, alpha=scale.real)
        layer[:, width:].add_(part, alpha=scale.imag)
    # beta has no real part.
    green = torch.cat([imaginary.mul_(-beta.imag), real.mul_(beta.imag)], dim=1)
    return green, layer


def _stacked(parts: list[csr_array]) -> csr_array:
    return csr_array(hstack(parts))


def _torch(matrix: csr_array) -> torch.Tensor:
    matrix = csr_array(matrix)
    with warnings.catch_warnings():
        warnings.filterwarnings("ignore", message="Sparse", category=UserWarning)
        return torch.sparse_csr_tensor(
            torch.from_numpy(matrix.indptr.astype(np.int64)),
            torch.from_numpy(matrix.indices.astype(np.int64)),
            torch.from_numpy(matrix.data.astype(np.float32)),
            size=matrix.shape,
        )


def _add(found: torch.Tensor, lefts: list[csr_array], product: torch.Tensor) -> None:
    """Multiply (K V, 2 b) by the edges' rows from the left, and add the products."""
    vertices, width = found.shape[0], product.shape[1] // 2
    touched = np.unique(np.concatenate([left.indices for left in lefts]))
    left = _torch(csr_array(_stacked([left[:, touched].T for left in lefts])))
    dense = product.view(len(lefts), vertices, 2, width).permute(0, 3, 2, 1)
    dense = dense.reshape(len(lefts) * width, 2 * vertices)
    found.view(vertices, -1).index_add_(
        0, torch.from_numpy(touched.astype(np.int64)), torch.sparse.mm(left, dense)
    )


def coupling(wavenumber: complex) -> complex:
    """Return Burton and Miller's factor of the normal derivative, m (Marburg 2016)."""
    return -1j / complex(wavenumber).real
