# SPDX-License-Identifier: MIT
"""Operators on a mesh whose vertices move: areas, curvature, smoothing."""

from __future__ import annotations

import warnings

import numpy as np
import torch
from scipy.sparse import coo_array, csr_array
from torch import Tensor

from sononerf.numerics import Ints

BENDING = 0.5
"""Length over which curvature is averaged, shortest wavelengths."""

TOLERANCE = 0.02
"""Relative residual at which the smoothing's conjugate gradients end; a step need not be exact."""
MOST_ITERATIONS = 200
"""Largest number of iterations of the conjugate gradients; smoothing lengths of a hundred edges
reach it."""


class MeshOperators:
    """Operators of one connectivity, on the device of its tensors.

    In: faces (T, 3).

    Attributes:
        faces (T, 3): Triangles.
        edges (K, 2): Each once.
        degree (V,): Neighbours of each vertex.
    """

    def __init__(self, faces: Tensor, count: int) -> None:
        self.faces, self.count = faces, count
        table: Ints = faces.detach().cpu().numpy()
        pairs = np.concatenate([table[:, [0, 1]], table[:, [1, 2]], table[:, [2, 0]]])
        pairs = np.unique(np.sort(pairs, axis=1), axis=0)
        both = np.concatenate([pairs, pairs[:, ::-1]])
        links = coo_array((np.ones(len(both)), (both[:, 0], both[:, 1])), shape=(count, count))
        self.edges = torch.as_tensor(pairs).to(faces.device)
        self._adjacency = sparse_tensor(links).to(faces.device)
        self._single = self._adjacency.float()
        self.degree = torch.as_tensor(np.diff(links.tocsr().indptr).astype(np.float64)).to(
            faces.device
        )
        self._corners = faces.reshape(-1)

    def areas(self, vertices: Tensor) -> Tensor:
        """Vector areas (V, 3) of vertices (V, 3): a third of that of each triangle about them."""
        a, b, c = vertices[self.faces].unbind(1)
        third = torch.linalg.cross(b - a, c - a) / 6.0
        return torch.zeros_like(vertices).index_add(
            0, self._corners, third.repeat_interleave(3, dim=0)
        )

    def edge_length(self, vertices: Tensor) -> float:
        """Mean length of the edges, m."""
        ends = vertices[self.edges]
        return float((ends[:, 0] - ends[:, 1]).norm(dim=1).mean())

    def neighbours(self, values: Tensor) -> Tensor:
        """Sum over the neighbours of each vertex (V, K) of values (V, K)."""
        single = values.dtype == torch.float32
        return (self._single if single else self._adjacency) @ values

    def averaged(self, values: Tensor) -> Tensor:
        """Mean (V, K) over each vertex and its neighbours of values (V, K)."""
        degree = self.degree.to(values.dtype)[:, None]
        return (self.neighbours(values) + values) / (degree + 1.0)

    def smoothed(self, values: Tensor, strength: float) -> Tensor:
        r"""Return :math:`(I + \lambda L)^{-1}` times values (V, K), with the graph's Laplacian.

        On an even mesh of edge h it smooths over the length :math:`h \sqrt{1.5 \lambda}`.

        In: values (V, K), strength (1). Out: smoothed (V, K).
        """
        diagonal = 1.0 + strength * self.degree[:, None]

        def apply(x: Tensor) -> Tensor:
            return diagonal * x - strength * (self._adjacency @ x)

        # The Jacobi sweep's start is close where values are smooth already.
        solution = self.averaged(values)
        residual = values - apply(solution)
        scale = values.square().sum(0).clamp_min(1e-300)
        direction = residual / diagonal
        inner = (residual * direction).sum(0)
        for _ in range(MOST_ITERATIONS):
            if bool((residual.square().sum(0) <= TOLERANCE**2 * scale).all()):
                break
            turned = apply(direction)
            along = inner / (direction * turned).sum(0).clamp_min(1e-300)
            solution = solution + along * direction
            residual = residual - along * turned
            conditioned = residual / diagonal
            after = (residual * conditioned).sum(0)
            direction = conditioned + (after / inner.clamp_min(1e-300)) * direction
            inner = after
        return solution

    def relaxed(self, vertices: Tensor, normals: Tensor, part: float) -> Tensor:
        """Move vertices (V, 3) along the surface by a part of the way to their neighbours' mean."""
        towards = self.averaged(vertices) - vertices
        towards = towards - (towards * normals).sum(1, keepdim=True) * normals
        return vertices + part * towards

    def bending(self, vertices: Tensor, normals: Tensor, passes: int) -> Tensor:
        """Curvature tensors, 1/m, positive where the surface is convex.

        In: vertices, normals (V, 3). Out: bending ((V, 6), 1/m).
        """
        a, b, c = vertices[self.faces].unbind(1)
        na, nb, nc = normals[self.faces].unbind(1)
        ab, ac = b - a, c - a
        sides = torch.linalg.cross(ab, ac)
        square = sides.square().sum(1, keepdim=True).clamp_min(1e-300)
        second, third = (
            torch.linalg.cross(ac, sides) / square,
            torch.linalg.cross(sides, ab) / square,
        )
        to_second, to_third = nb - na, nc - na
        change = second[:, :, None] * to_second[:, None] + third[:, :, None] * to_third[:, None]
        change = 0.5 * (change + change.transpose(1, 2))
        parts = torch.stack(
            [
                change[:, 0, 0], change[:, 1, 1], change[:, 2, 2],
                change[:, 0, 1], change[:, 0, 2], change[:, 1, 2],
            ],
            dim=1,
        )  # fmt: skip
        area = square.sqrt()
        weighted = torch.cat([parts * area, area], dim=1).repeat_interleave(3, dim=0)
        total = torch.zeros(self.count, 7, dtype=vertices.dtype, device=vertices.device)
        total = total.index_add(0, self._corners, weighted)
        found = total[:, :6] / total[:, 6:].clamp_min(1e-300)
        for _ in range(passes):
            found = self.averaged(found)
        return found


def sparse_tensor(matrix: coo_array | csr_array) -> Tensor:
    """Return a sparse matrix as a tensor in double precision."""
    rows = matrix.tocsr()
    ends, columns = (torch.as_tensor(p.astype(np.int64)) for p in (rows.indptr, rows.indices))
    data = torch.as_tensor(rows.data.astype(np.float64))
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # torch calls them beta; products are all we use
        return torch.sparse_csr_tensor(ends, columns, data, rows.shape, check_invariants=False)


def unit(vectors: Tensor) -> Tensor:
    """Vectors (..., 3) of length 1; those of length 0 stay."""
    return vectors / vectors.norm(dim=-1, keepdim=True).clamp_min(1e-300)


def tangents(normals: Tensor) -> tuple[Tensor, Tensor]:
    """Two unit vectors (N, 3) square to unit normals (N, 3) and to each other [1]_.

    References:
        .. [1] T. Duff et al., "Building an orthonormal basis, revisited", JCGT 6(1), 2017.
    """
    x, y, z = normals.unbind(1)
    sign = torch.where(z >= 0.0, 1.0, -1.0).to(normals.dtype)
    a = -1.0 / (sign + z)
    b = x * y * a
    return (
        torch.stack([1.0 + sign * x * x * a, sign * b, -sign * x], dim=1),
        torch.stack([b, sign + y * y * a, -y], dim=1),
    )


def smoothing_passes(wavelength: float, edge: float) -> int:
    """Return the number of averages of curvature, from wavelength and edge, m."""
    return max(1, round(2.0 * (BENDING * wavelength / edge) ** 2))
