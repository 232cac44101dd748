# SPDX-License-Identifier: MIT
"""Multi-resolution dense grids with a physics-shaped head: a reflection lobe at every place."""

from __future__ import annotations

import math
from typing import Annotated

import torch
import torch.nn.functional as F
from pydantic import Field as Option
from torch import Tensor, nn

from sononerf.field.correction import Correction
from sononerf.field.lobe import CODE, LobeField


class GridField(LobeField):
    """Lobes on dense grids, read by trilinear interpolation and summed over the levels.

    Parameters
    ----------
    region : (2, 3) float, m
        Lower and upper corner of the box, world frame.
    frequency : (F,) float, Hz
        Frequencies of the answer.
    spacing : float or None, m
        Vertex spacing of the finest level; found from ``vertices`` where None.
    vertices : int
        How many vertices the finest level may have where ``spacing`` is None.
    finest, coarsest : float, m
        Bounds of the spacing that is found.
    levels : int
        Number of grids, each twice as coarse as the one before.
    rank : int
        Number of spectra that places add by coefficients of their own; at most one less than
        there are frequencies.
    correction : int
        Width of the hidden layers of a network that corrects what places answer; 0 for none.
        Only :meth:`select` and :meth:`echo` hear it: which places are audible, and their energy
        and axis, go by the lobe alone.
    """

    origin: Tensor

    def __init__(
        self,
        region: Tensor,
        frequency: Tensor,
        *,
        spacing: Annotated[float, Option(gt=0)] | None = None,
        vertices: Annotated[int, Option(ge=8)] = 1_000_000,
        finest: Annotated[float, Option(gt=0)] = 0.004,
        coarsest: Annotated[float, Option(gt=0)] = 0.02,
        levels: Annotated[int, Option(ge=1, le=8)] = 3,
        rank: Annotated[int, Option(ge=0, le=64)] = 0,
        correction: Annotated[int, Option(ge=0, le=256)] = 0,
    ) -> None:
        super().__init__(region, frequency, rank)
        extent = (region[1] - region[0]).double()
        if spacing is None:
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
        self.correction = (
            Correction(region, spacing, correction, len(frequency)) if correction else None
        )

    @property
    def resolution(self) -> float:
        """Vertex spacing of the finest level in metres."""
        return self.spacing

    def code(self, positions: Tensor) -> Tensor:
        """Read what (N, 3) places are, (N, 5 + rank); see the base class."""
        total = positions.new_zeros(positions.shape[0], CODE + self.rank)
        for level, grid in enumerate(self.grids):
            step = self.spacing * 2**level
            size = positions.new_tensor([grid.shape[4], grid.shape[3], grid.shape[2]]) - 1
            unit = (positions - self.origin) / (step * size.clamp_min(1)) * 2 - 1
            read = F.grid_sample(
                grid, unit[None, None, None], align_corners=True, padding_mode="border"
            )
            total = total + read[0, :, 0, 0].T
        return total

    def _log_response(
        self,
        code: Tensor,
        positions: Tensor,
        directions: Tensor,
        bins: Tensor | None,
        place: Tensor | None = None,
    ) -> Tensor:
        response = super()._log_response(code, positions, directions, bins, place)
        if self.correction is None:
            return response
        return response + self.correction(positions, directions, bins, place)
