# SPDX-License-Identifier: MIT
"""Multi-resolution dense grids with a physics-shaped head: a reflection lobe at every place."""

from __future__ import annotations

import math
import warnings
from typing import Annotated, Any

import torch
import torch.nn.functional as F
from pydantic import Field as Option
from torch import Tensor, nn

from sononerf.errors import SettingsError
from sononerf.field.lobe import CODE, LobeField

SLIGHT = 1e-5
"""Weight below which a vertex of the grid is not read: rounding moves places of a lattice by as
much."""


class _Product(torch.autograd.Function):
    """Multiply a sparse (N, T) matrix, given with its transpose, with a dense (T, C)."""

    @staticmethod
    def forward(ctx: Any, matrix: Tensor, transpose: Tensor, dense: Tensor) -> Tensor:
        ctx.transpose = transpose
        return matrix @ dense

    @staticmethod
    def backward(ctx: Any, *gradients: Tensor) -> tuple[Tensor | None, ...]:
        return None, None, ctx.transpose @ gradients[0].contiguous()


class _Reading:
    """Trilinear interpolation at fixed places, as a sparse matrix.

    Most places of a lattice lie on vertices of the finest grid and between few of the coarser ones.
    So ten products replace eight per grid, which would be recomputed each time.

    In: places ((N, 3), m), origin ((3,), m), steps (list of float, m), grids (list of (1, C, Z, Y,
    X) float).
    """

    def __init__(
        self, places: Tensor, origin: Tensor, steps: list[float], grids: list[Tensor]
    ) -> None:
        self.places = places
        self.device, self.dtype = grids[0].device, grids[0].dtype
        self._vertices: list[Tensor] = []  # of each grid, those that are read
        row, column, weight = [], [], []
        here = torch.arange(len(places), device=self.device)
        count = 0
        for step, grid in zip(steps, grids, strict=True):
            size = torch.tensor(grid.shape[:1:-1], device=self.device)  # (X, Y, Z)
            unit = (places.double() - origin) / step
            unit = unit.clamp_min(0).minimum((size - 1).double())
            near = unit.long().minimum((size - 2).clamp_min(0))
            part = unit - near
            stride = torch.stack((torch.ones_like(size[0]), size[0], size[0] * size[1]))
            of, vertex, share = [], [], []
            for corner in torch.cartesian_prod(*[torch.arange(2, device=self.device)] * 3):
                factor = torch.where(corner == 1, part, 1 - part).prod(dim=1)
                read = factor > SLIGHT
                of.append(here[read])
                vertex.append(((near[read] + corner) * stride).sum(dim=1))
                share.append(factor[read])
            flat = torch.cat(vertex)
            is_corner = torch.zeros(int(size.prod()), dtype=torch.bool, device=self.device)
            is_corner[flat] = True
            row.append(torch.cat(of))
            column.append((is_corner.cumsum(0) - 1)[flat] + count)
            weight.append(torch.cat(share))
            self._vertices.append(is_corner.nonzero()[:, 0])
            count += len(self._vertices[-1])
        index, value = torch.stack((torch.cat(row), torch.cat(column))), torch.cat(weight)
        shape = (len(places), count)
        with warnings.catch_warnings():
            warnings.filterwarnings("ignore", "Sparse CSR tensor support is in beta")
            # torch 2.11 says so although it is told not to check.
            warnings.filterwarnings("ignore", "Sparse invariant checks are implicitly disabled")
            self._matrix = self._compressed(index, value, shape)
            self._transpose = self._compressed(index.flip(0), value, shape[::-1])

    def _compressed(self, index: Tensor, value: Tensor, shape: tuple[int, ...]) -> Tensor:
        entries = torch.sparse_coo_tensor(
            index, value.to(self.dtype), shape, check_invariants=False
        )
        return entries.to_sparse_csr()

    def __call__(self, grids: list[Tensor]) -> Tensor:
        """Return the values at the places, summed over the grids, (N, C)."""
        read = [
            grid.reshape(grid.shape[1], -1).index_select(1, vertices)
            for grid, vertices in zip(grids, self._vertices, strict=True)
        ]
        return _Product.apply(self._matrix, self._transpose, torch.cat(read, dim=1).T)

    def holds(self, places: Tensor, grid: Tensor) -> bool:
        """Return whether this matrix belongs to these places and to grids like this."""
        return self.places is places and self.device == grid.device and self.dtype == grid.dtype


class GridField(LobeField):
    """Lobes on dense grids, read by trilinear interpolation and summed over the levels.

    In: region ((2, 3), m), frequency ((F,), Hz), spacing (m), finest, coarsest (m).
    """

    origin: Tensor

    def __init__(
        self,
        region: Tensor,
        frequency: Tensor,
        *,
        spacing: Annotated[float, Option(gt=0, le=0.1)] | None = None,
        vertices: Annotated[int, Option(ge=8)] = 1_000_000,
        finest: Annotated[float, Option(gt=0, le=0.1)] = 0.004,
        coarsest: Annotated[float, Option(gt=0, le=0.1)] = 0.02,
        levels: Annotated[int, Option(ge=1, le=8)] = 3,
        rank: Annotated[int, Option(ge=0, le=64)] = 0,
    ) -> None:
        super().__init__(region, frequency, rank)
        extent = (region[1] - region[0]).double()
        if spacing is None:
            if finest > coarsest:
                raise SettingsError(
                    f"field.options.finest: found {finest:g}; must not lie above coarsest, "
                    f"{coarsest:g}"
                )
            spacing = float((extent.prod() / vertices) ** (1 / 3))
            spacing = min(max(spacing, finest), coarsest)
        self.spacing = spacing
        self.register_buffer("origin", region[0].clone())
        self.grids = nn.ParameterList()
        for level in range(levels):
            step = spacing * 2**level
            size = [math.ceil(float(e) / step - 1e-6) + 1 for e in extent]
            # Channels as in a code; grid_sample wants (Z, Y, X).
            self.grids.append(nn.Parameter(torch.zeros(1, CODE + self.rank, *size[::-1])))
        self._reading: _Reading | None = None

    @property
    def _steps(self) -> list[float]:
        return [self.spacing * 2**level for level in range(len(self.grids))]

    @property
    def resolution(self) -> float:
        """Vertex spacing of the finest level in metres."""
        return self.spacing

    def code(self, positions: Tensor) -> Tensor:
        """Return the parameters of places (N, 3), (N, 5 + rank); see the base class."""
        total = positions.new_zeros(positions.shape[0], CODE + self.rank)
        for step, grid in zip(self._steps, self.grids, strict=True):
            size = positions.new_tensor([grid.shape[4], grid.shape[3], grid.shape[2]]) - 1
            unit = (positions - self.origin) / (step * size.clamp_min(1)) * 2 - 1
            read = F.grid_sample(
                grid, unit[None, None, None], align_corners=True, padding_mode="border"
            )
            total = total + read[0, :, 0, 0].T
        return total

    def code_of_lattice(self, lattice: Tensor, which: Tensor | None) -> Tensor:
        """Return the parameters of a lattice's places; see the base class."""
        grids = list(self.grids)
        if self._reading is None or not self._reading.holds(lattice, grids[0]):
            with torch.inference_mode(False), torch.no_grad():
                self._reading = _Reading(lattice, self.origin, self._steps, grids)
        code = self._reading(grids)
        return code if which is None else code.index_select(0, which)
