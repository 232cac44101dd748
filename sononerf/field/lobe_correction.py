# SPDX-License-Identifier: MIT
"""Correction of a lobe's log strength by a small network."""

from __future__ import annotations

import math

import torch
from torch import Tensor, nn

from sononerf.field.lobe import CALM, CalmLayer, hidden_layers

LARGEST = 3.0
"""Largest correction, as a natural logarithm: 26 dB."""


def harmonics(directions: Tensor) -> Tensor:
    """Return the real spherical harmonics up to degree 3.

    Args:
        directions (..., 3): Unit vectors.

    Returns:
        harmonics (..., 16): By degree; the mean of their squares over the sphere is one, of
            products zero.

    References:
        .. [1] M. A. Blanco, M. Flórez, M. Bermejo, "Evaluation of the rotation matrices in the
           basis of real spherical harmonics", Journal of Molecular Structure: THEOCHEM 419:19-27,
           1997.
    """
    x, y, z = directions.unbind(-1)
    polynomials = (
        (1.0, torch.ones_like(x)),
        *((3.0, first) for first in (x, y, z)),
        *((15.0, second) for second in (x * y, y * z, z * x, (x * x - y * y) / 2)),
        (5.0, (3 * z * z - 1) / 2),
        (7.0, z * (5 * z * z - 3) / 2),
        *((21 / 8, third * (5 * z * z - 1)) for third in (x, y)),
        *((105.0, third * z) for third in (x * y, (x * x - y * y) / 2)),
        (35 / 8, x * (x * x - 3 * y * y)),
        (35 / 8, y * (3 * x * x - y * y)),
    )
    # Contiguous in memory over the pairs; see LobeField.
    return torch.stack([math.sqrt(square) * value for square, value in polynomials]).movedim(0, -1)


class Correction(nn.Module):
    r"""A network's addition to the log strength: zero at first, and never beyond ``LARGEST``.

    Its inputs are sines and cosines of the position, whose wavelengths fall by halves from twice
    the region's longest side to four times the spacing, and the spherical harmonics of the
    direction; of its output :math:`y` it returns :math:`L \tanh(y / L)`.

    Args:
        region ((2, 3), m): Lower and upper corner of the box, world frame.
        spacing (m): Spacing of the field that is corrected.
    """

    origin: Tensor
    waves: Tensor

    def __init__(self, region: Tensor, spacing: float, width: int, count: int) -> None:
        super().__init__()
        finest = 4 * spacing
        longest = max(2 * float((region[1] - region[0]).max()), finest)
        octaves = math.floor(math.log2(longest / finest) + 1e-6) + 1
        # Both follow from the field's region and options, so they need not be kept.
        self.register_buffer("origin", region[0].clone(), persistent=False)
        waves = 2 * math.pi / longest * 2.0 ** torch.arange(octaves)
        self.register_buffer("waves", waves, persistent=False)  # rad/m
        self.hidden = hidden_layers(6 * octaves + 16, width)
        self.out = CalmLayer(width, count)
        nn.init.zeros_(self.out.weight)

    def forward(
        self,
        positions: Tensor,
        directions: Tensor,
        bins: Tensor | None,
        place: Tensor | None = None,
    ) -> Tensor:
        """Return the addition to the log strength, differentiable in the parameters.

        Args:
            positions ((N, 3), m): Places, world frame.
            directions ((..., N, 3) or (M, 3)): Unit vectors to the emitter; the latter with
                ``place``.
            bins ((B,) int or None): Indices of the frequencies; all where None.
            place ((M,) int or None): Index of the place of each direction.

        Returns:
            correction: (..., N, B) or (M, B).
        """
        # The first layer's response to a place is computed once for all its directions.
        phase = (self.waves[:, None] * (positions - self.origin).T[:, None]).flatten(0, 1)
        of_place = torch.cat((phase.sin(), phase.cos()))
        (first, bias), second = _calm(self.hidden[0]), _calm(self.hidden[2])
        known = torch.addmm(bias, first[:, : len(of_place)], of_place)  # (width, N)
        if place is not None:
            known = known.index_select(1, place)
        told = harmonics(directions).movedim(-1, 0)  # (16, ..., N)
        shape = told.shape[1:]
        known = known.reshape(len(known), *[1] * (len(shape) - 1), shape[-1]).expand(-1, *shape)
        hidden = torch.addmm(known.flatten(1), first[:, len(of_place) :], told.flatten(1)).relu()
        hidden = torch.addmm(second[1], second[0], hidden).relu()
        weight, bias = _calm(self.out)
        which = slice(None) if bins is None else bins
        wanted = torch.addmm(bias[which], weight[which], hidden)
        wanted = wanted.reshape(len(wanted), *shape).movedim(0, -1)
        return LARGEST * torch.tanh(wanted / LARGEST)


def _calm(layer: nn.Module) -> tuple[Tensor, Tensor]:
    """Return a layer's effective weight and bias, a column."""
    assert isinstance(layer, CalmLayer)
    return layer.weight * CALM, layer.bias[:, None] * CALM
