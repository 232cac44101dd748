from typing import Annotated

import torch
from pydantic import Field as Option
from sononerf import Field, Head, Renderer
from sononerf.field.field import lattice_over
from sononerf.field.renderer import look_up
from torch import Tensor


class LatticeRenderer(Renderer):
    """Adds the power of places on a lattice in the range slice that each lies in.

    Args:
        region ((2, 3), m): Lower and upper corner of the box that holds the field.
        head: The head that heard the spectra.
        spacing (m): Spacing of the lattice.
    """

    lattice: Tensor

    def __init__(
        self,
        region: Tensor,
        head: Head,
        *,
        spacing: Annotated[float, Option(gt=0, le=0.1)] = 0.004,
    ) -> None:
        super().__init__(region, head)
        self.register_buffer("lattice", lattice_over(region, spacing), persistent=False)

    def forward(
        self,
        field: Field,
        position: Tensor,
        rotation: Tensor,
        rows: Tensor,
        bins: Tensor | None = None,
    ) -> Tensor:
        if bins is None:
            bins = torch.arange(len(self.frequency), device=rows.device)
        poses = []
        for place, turn, some in zip(position, rotation, rows, strict=True):
            offset = self.lattice - (place + turn @ self.emitter)
            distance = offset.norm(dim=-1)
            unit = offset / distance[:, None]
            power = field.select(self.lattice, -unit, bins).abs().square()
            power = power / distance[:, None] ** 4
            power = power * look_up(self.beam[bins], unit @ turn) ** 2
            step = self.range[1] - self.range[0]
            row = ((distance - self.range[0]) / step).round().long()
            heard = (row >= 0) & (row < len(self.range))
            ears = []
            for table in self.ears:
                sound = power * look_up(table[bins], unit @ turn) ** 2
                silent = sound.new_zeros(len(self.range), len(bins))
                ears.append(silent.index_add(0, row[heard], sound[heard])[some])
            poses.append(torch.stack(ears))
        return self.log_gain.exp() * (torch.stack(poses) + 1e-24).sqrt()


make = LatticeRenderer
