# SPDX-License-Identifier: MIT
"""Multi-resolution dense grids with a physics-shaped head: a reflection lobe at every place."""

from __future__ import annotations

import math
from typing import Annotated

import torch
import torch.nn.functional as F
from pydantic import Field as Option
from torch import Tensor, nn

from sononerf.field.field import Field

LOG_STRENGTH_FLOOR = -18.0
QUIETEST = -5.0
"""A lobe is left out where it is this much below its own peak, as a natural logarithm: -43 dB."""
CURVED_AFTER = 0.4
"""Share of the fit after which places may be curved: before, they are not where they belong."""
RADIUS_UNIT = 0.015
"""What one unit of the learned number is in metres: how fast the radii are learned."""


class GridField(Field):
    r"""Lobes on dense grids, read by trilinear interpolation.

    .. math:: \rho(x, u, f) = \exp\big(a(x) + \kappa_f (m(x) \cdot u - |m(x)|) + s_f\big)

    The log strength :math:`a` and the lobe vector :math:`m` are sums over the levels'
    interpolated values; :math:`m` points along the surface normal and its length is the
    lobe's concentration; :math:`\kappa_f` sharpens the lobe with frequency and :math:`s_f`
    is one spectrum for the whole field.

    A lobe stands for a piece of surface between two vertices, which is curved: at an angle
    :math:`\theta` off the axis the echo comes from :math:`R(x) (1 - \cos\theta)` nearer. Without
    the radius of curvature :math:`R`, learned late, all echoes off the axis would be too far, and
    the places would move outward to make up for it.

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
    """

    learning_rate = 0.05
    knows_directions = True
    origin: Tensor
    curved: Tensor

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
    ) -> None:
        super().__init__(region, frequency)
        extent = (region[1] - region[0]).double()
        if spacing is None:
            spacing = float((extent.prod() / vertices) ** (1 / 3))
            spacing = min(max(spacing, finest), coarsest)
        self.spacing = spacing
        self.register_buffer("origin", region[0].clone())
        self.register_buffer("curved", torch.zeros(()))
        self.grids = nn.ParameterList()
        for level in range(levels):
            step = spacing * 2**level
            size = [math.ceil(float(e) / step - 1e-6) + 1 for e in extent]
            # Channels: log strength, lobe vector (x, y, z), radius; grid_sample wants (Z, Y, X).
            self.grids.append(nn.Parameter(torch.zeros(1, 5, size[2], size[1], size[0])))
        self.spectrum = nn.Parameter(torch.zeros(len(frequency)))
        self.sharpness = nn.Parameter(torch.zeros(len(frequency)))

    @property
    def resolution(self) -> float:
        """Vertex spacing of the finest level in metres."""
        return self.spacing

    def advance(self, step: int, total: int) -> None:
        """Let places be curved once they are about where they belong."""
        self.curved.fill_(float(step >= CURVED_AFTER * total))

    def code(self, positions: Tensor) -> Tensor:
        """Read log strength, lobe vector and radius of curvature at (N, 3) places: (N, 5)."""
        total = positions.new_zeros(positions.shape[0], 5)
        for level, grid in enumerate(self.grids):
            step = self.spacing * 2**level
            size = positions.new_tensor([grid.shape[4], grid.shape[3], grid.shape[2]]) - 1
            unit = (positions - self.origin) / (step * size.clamp_min(1)) * 2 - 1
            read = F.grid_sample(
                grid, unit[None, None, None], align_corners=True, padding_mode="border"
            )
            total = total + read[0, :, 0, 0].T
        return total

    def _log_response(self, code: Tensor, directions: Tensor, bins: Tensor | None) -> Tensor:
        spectrum = self.spectrum if bins is None else self.spectrum[bins]
        sharpness = (self.sharpness if bins is None else self.sharpness[bins]).exp()
        strength, lobe = code[:, 0], code[:, 1:4]
        # The small number keeps the gradient finite where there is no lobe yet.
        length = (lobe.square().sum(-1) + 1e-6).sqrt()
        tilt = (directions * lobe).sum(-1) - length  # (..., N), zero on the axis
        return (
            strength.clamp_min(LOG_STRENGTH_FLOOR)[:, None] + tilt[..., None] * sharpness + spectrum
        )

    def select(self, positions: Tensor, directions: Tensor, bins: Tensor | None) -> Tensor:
        """Return the reflectivity of (N, 3) places towards (..., N, 3) directions."""
        response = self._log_response(self.code(positions), directions, bins).exp()
        return response * self.inside(positions)[:, None]

    @torch.no_grad()
    def audible(self, positions: Tensor, directions: Tensor) -> Tensor:
        """Return which places answer towards which directions, (P, N) bool."""
        lobe = self.code(positions)[:, 1:4]
        tilt = (directions * lobe).sum(-1) - lobe.norm(dim=-1)
        return tilt * self.sharpness.min().exp() > QUIETEST

    def echo(
        self,
        positions: Tensor,
        directions: Tensor,
        bins: Tensor | None,
        place: Tensor | None = None,
    ) -> tuple[Tensor, Tensor]:
        """Return the reflectivity, (M, B), and how much nearer it comes from, (M,) m."""
        code, inside = self.code(positions), self.inside(positions)
        if place is not None:
            code, inside = code[place], inside[place]
        response = self._log_response(code, directions, bins).exp()
        lobe = code[:, 1:4].detach()  # the range must not turn the lobes
        cosine = (directions * lobe).sum(-1) / lobe.norm(dim=-1).clamp_min(1e-6)
        lead = RADIUS_UNIT * self.curved * code[:, 4] * (1 - cosine)
        return response * inside[:, None], lead

    def forward(self, positions: Tensor, directions: Tensor) -> Tensor:
        """Return the reflectivity, (..., F) float."""
        shape = torch.broadcast_shapes(positions.shape, directions.shape)
        flat = positions.expand(shape).reshape(-1, 3)
        response = self.select(flat, directions.expand(shape).reshape(-1, 3), None)
        return response.reshape(*shape[:-1], -1)

    @torch.no_grad()
    def oriented(self, positions: Tensor, directions: int) -> tuple[Tensor, Tensor]:
        r"""Return energy and axis from the lobe itself, exact where a lattice would be too coarse.

        The mean over the sphere of :math:`e^{2k(\cos - 1)}` is :math:`(1 - e^{-4k})/(4k)`.
        """
        del directions
        code = self.code(positions)
        length = code[:, 1:4].norm(dim=-1)
        concentration = length[:, None] * self.sharpness.exp()
        mean = -torch.expm1(-4 * concentration) / (4 * concentration).clamp_min(1e-12)
        mean = torch.where(concentration > 1e-6, mean, torch.ones_like(mean))
        power = (2 * (code[:, :1].clamp_min(LOG_STRENGTH_FLOOR) + self.spectrum)).exp() * mean
        energy = power.sum(-1) * self.inside(positions)
        return energy, code[:, 1:4] / length.clamp_min(1e-12)[:, None]
