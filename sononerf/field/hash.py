# SPDX-License-Identifier: MIT
"""A multi-resolution hash grid with a physics-shaped head, for large or fine scenes."""

from __future__ import annotations

import math
from typing import Annotated, Any

import torch
import torch.nn.functional as F
from pydantic import Field as Option
from torch import Tensor, nn

from sononerf.field.lobe import CALM, CODE, CalmLayer, LobeField, hidden_layers

PRIMES = (1, 2654435761, 805459861)
"""Factors of the indices of a vertex along x, y and z; Müller et al. 2022, eq. 4."""
CHUNK = 65_536
"""Number of places that are evaluated at once; it bounds the memory."""


class _Blend(torch.autograd.Function):
    """Weighted sums of a table's rows; torch's own gradient of them takes several times as long."""

    @staticmethod
    def forward(ctx: Any, table: Tensor, entries: Tensor, weights: Tensor) -> Tensor:
        ctx.save_for_backward(entries, weights)
        ctx.shape = table.shape
        return F.embedding_bag(entries.T, table, mode="sum", per_sample_weights=weights.T)

    @staticmethod
    def backward(ctx: Any, *gradients: Tensor) -> tuple[Tensor, None, None]:
        entries, weights = ctx.saved_tensors
        rows, columns = ctx.shape
        total = weights.new_zeros(columns, rows)
        for row, gradient in zip(total, gradients[0].unbind(1), strict=True):
            row.scatter_add_(0, entries.reshape(-1), (weights * gradient).reshape(-1))
        return total.T, None, None


class HashField(LobeField):
    """Lobes read out of a multi-resolution hash grid by a small network.

    Each level is a cubic lattice with a feature vector per vertex. A level whose vertices fit
    into the table has one entry for each of them; in a finer one vertices share entries, by a
    hash of their numbers [1]_. The levels' features, interpolated trilinearly, go through two
    hidden layers, and past them, to the parameters of the places. A fit begins with the coarsest
    level; the finer ones follow one after the other.

    Args:
        region ((2, 3), m): Lower and upper corner of the box, world frame.
        frequency ((F,), Hz): Frequencies of the answer.
        finest (m): Vertex spacing of the finest level.
        rank: Number of spectra that places add by coefficients of their own; at most one less than
            there are frequencies.

    References:
        .. [1] T. Müller, A. Evans, C. Schied, A. Keller, "Instant neural graphics primitives with a
           multiresolution hash encoding", ACM Transactions on Graphics 41(4):102, 2022.
    """

    progress: Tensor
    _last: Tensor
    _factors: Tensor

    def __init__(
        self,
        region: Tensor,
        frequency: Tensor,
        *,
        finest: Annotated[float, Option(gt=0, le=0.1)] = 0.002,
        growth: Annotated[float, Option(ge=1.1, le=4)] = 2.0,
        levels: Annotated[int, Option(ge=1, le=24)] = 5,
        features: Annotated[int, Option(ge=1, le=16)] = 4,
        log2_entries: Annotated[int, Option(ge=3, le=24)] = 17,
        width: Annotated[int, Option(ge=1, le=256)] = 32,
        rank: Annotated[int, Option(ge=0, le=64)] = 6,
        released: Annotated[float, Option(gt=0, le=1)] = 0.4,
    ) -> None:
        super().__init__(region, frequency, rank)
        self.spacings = [finest * growth ** (levels - 1 - level) for level in range(levels)]
        self.released = released
        self._mask = 2**log2_entries - 1
        extent = (region[1] - region[0]).double().tolist()
        self._first, self._shared = [0], []
        last, factors = [], []
        for spacing in self.spacings:
            size = [max(math.ceil(side / spacing - 1e-6), 1) + 1 for side in extent]
            vertices = math.prod(size)
            self._shared.append(vertices > 2**log2_entries)
            self._first.append(self._first[-1] + min(vertices, 2**log2_entries))
            last.append([count - 1 for count in size])
            factors.append(PRIMES if self._shared[-1] else (1, size[0], size[0] * size[1]))
        # All follow from the region and the options, so they need not be kept.
        self.register_buffer("_last", torch.tensor(last), persistent=False)
        self.register_buffer("_factors", torch.tensor(factors), persistent=False)
        self.register_buffer("progress", torch.ones(()))
        self.table = nn.Parameter(torch.zeros(self._first[-1], features).uniform_(-1e-4, 1e-4))
        self.hidden = hidden_layers(levels * features, width)
        self.out = CalmLayer(width + levels * features, CODE + self.rank)
        with torch.no_grad():
            # At first each level adds to strength and lobe as if it held nothing else. Nothing is
            # curved until it is learned, and that begins late.
            start = torch.eye(CODE + self.rank, features).repeat(1, levels)
            self.out.weight[:, width:] = start / CALM
            self.out.weight[CODE - 1] = 0.0

    @property
    def resolution(self) -> float:
        """Vertex spacing of the finest level in metres."""
        return self.spacings[-1]

    def advance(self, step: int, total: int) -> None:
        """Release levels, and let places be curved; how far that has come is kept."""
        super().advance(step, total)
        self.progress.fill_(step / total)

    def release(self) -> Tensor:
        """Return how far each level takes part, (L,), from the coarsest to the finest."""
        behind = torch.arange(len(self._last), device=self.progress.device)
        reached = self.progress / self.released * (len(self._last) - 1)
        return (1 + reached - behind).clamp(0.0, 1.0)

    def corners(self, positions: Tensor, level: int) -> tuple[Tensor, Tensor]:
        """Return the eight vertices around each place as entries of the table, and their weights.

        Args:
            positions ((N, 3), m): Places, world frame; those outside the lattice are moved to its
                faces.

        Returns:
            entries (8, N): Rows of the table.
            weights (8, N): Trilinear; they sum to one.
        """
        last = self._last[level]
        unit = ((positions - self.region[0]) / self.spacings[level]).clamp_min(0).minimum(last)
        cell = unit.long().minimum(last - 1)
        upper = (unit - cell).T
        number = cell.T * self._factors[level][:, None]
        number = torch.stack((number, number + self._factors[level][:, None]), dim=1)
        x, y, z = number[0, :, None, None], number[1, None, :, None], number[2, None, None, :]
        entry = (x ^ y ^ z) & self._mask if self._shared[level] else x + y + z  # (2, 2, 2, N)
        weight = torch.stack((1 - upper, upper), dim=1)
        x, y, z = weight[0, :, None, None], weight[1, None, :, None], weight[2, None, None, :]
        return (entry + self._first[level]).reshape(8, -1), (x * y * z).reshape(8, -1)

    def encode(self, positions: Tensor) -> Tensor:
        """Interpolate the features of all levels at (N, 3) places: (N, L * features)."""
        corners = [self.corners(positions, level) for level in range(len(self._last))]
        entries, weights = (torch.cat(part, dim=1) for part in zip(*corners, strict=True))
        read: Tensor = _Blend.apply(self.table, entries, weights)  # (L * N, features)
        read = read.reshape(len(corners), len(positions), self.table.shape[1])
        return (read * self.release()[:, None, None]).transpose(0, 1).flatten(1)

    def code(self, positions: Tensor) -> Tensor:
        """Return the parameters of places (N, 3), (N, 5 + rank); see the base class."""
        features = self.encode(positions)
        code: Tensor = self.out(torch.cat((self.hidden(features), features), dim=1))
        return code

    @torch.no_grad()
    def oriented(self, positions: Tensor, directions: int) -> tuple[Tensor, Tensor]:
        """Return energy and axis; one part after the other, for eight corners each take room."""
        whole = super().oriented
        parts = [whole(part, directions) for part in positions.split(CHUNK)]
        energy, axis = (torch.cat(part) for part in zip(*parts, strict=True))
        return energy, axis
