# SPDX-License-Identifier: MIT
"""The paper's renderer: one hemisphere of directions at one range, summed as complex numbers."""

from __future__ import annotations

from typing import Annotated, Literal

import torch
from pydantic import Field as Option
from torch import Tensor, nn

from sononerf.field.field import Field, sphere_directions
from sononerf.field.renderer import Renderer, look_up
from sononerf.head.head import Head


class ShellRenderer(Renderer):
    r"""Equation 17 of the paper.

    .. math:: S_e(f, r) = \frac{g\, c_f}{D} \Big| \sum_d F(p + r d, v)\, E_e(d, f) \Big|

    The equation's phase factor depends on frequency and range alone and cancels in the
    magnitude. There is no spreading, no absorption and no delay between the ears, as there.
    The gain g is learned. Of a call spectrum c the equation knows nothing: it is 1, or learned as
    the published code does. Places outside the field's region are zero
    and are not computed.

    Args:
        region ((2, 3), m): Lower and upper corner of the box that holds the field.
        head: What heard the spectra.
        directions: Number of directions over the forward hemisphere.
        direction: What the field is told: the direction from each place to the head, or, as the
            published code does, the sensor's own look direction (reversed) for all places of a
            call.
        call_spectrum: Whether each frequency has a gain of its own.

    References:
        .. [1] Jansen & Steckel, Biomimetics 9(6):321, 2024, equation 17.
    """

    whole_poses = False
    directions: Tensor
    transfer: Tensor

    def __init__(
        self,
        region: Tensor,
        head: Head,
        *,
        directions: Annotated[int, Option(ge=1)] = 600,
        direction: Literal["incidence", "sensor"] = "incidence",
        call_spectrum: Literal["flat", "learned"] = "flat",
    ) -> None:
        super().__init__(region, head)
        self.told = direction
        sphere = sphere_directions(2 * directions, self.range)
        # Turned so that the lattice's axis is the head's: its first half is then the hemisphere.
        forward = sphere[:directions][:, [2, 0, 1]]
        self.register_buffer("directions", forward)
        ears = torch.stack(
            [look_up(self.beam * self.ears[e], forward) for e in range(len(self.ears))]
        )
        self.register_buffer("transfer", ears)  # (E, D, F)
        self.log_spectrum = nn.Parameter(
            torch.zeros(len(self.frequency)), requires_grad=call_spectrum == "learned"
        )

    def forward(
        self,
        field: Field,
        position: Tensor,
        rotation: Tensor,
        rows: Tensor,
        bins: Tensor | None = None,
    ) -> Tensor:
        """Render; see the base class. Differentiable in the field and in what is learned."""
        transfer = self.transfer if bins is None else self.transfer[..., bins]
        spectrum = self.log_spectrum if bins is None else self.log_spectrum[bins]
        world = torch.einsum("pij,dj->pdi", rotation, self.directions)  # (P, D, 3)
        places = position[:, None, None] + self.range[rows][..., None, None] * world[:, None]
        told = -world if self.told == "incidence" else -rotation[:, None, :, 0].expand(world.shape)
        told = told[:, None].expand(places.shape)
        inside = field.inside(places)  # (P, R, D)
        self.points_evaluated += inside.sum()
        slice_index, direction_index = inside.flatten(0, 1).nonzero(as_tuple=True)
        response = field.select(places[inside], told[inside], bins)  # (N, B)
        sums = []
        for ear in transfer:
            echo = response * ear[direction_index]
            total = echo.new_zeros(inside.shape[0] * inside.shape[1], echo.shape[-1])
            sums.append(total.index_add(0, slice_index, echo))
        total = torch.stack(sums)  # (E, P R, B)
        # The magnitude's gradient at exactly zero is not defined; a field that is zero there
        # has none. That much less than the root of a little more, and exactly zero of zero.
        power = total.real.square() + total.imag.square() if total.is_complex() else total.square()
        magnitude = power / ((power + 1e-20).sqrt() + 1e-10)
        scale = (self.log_gain + spectrum).exp() / len(self.directions)
        shape = (len(transfer), inside.shape[0], inside.shape[1], -1)
        return (magnitude * scale).reshape(shape).transpose(0, 1)
