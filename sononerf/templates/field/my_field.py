from itertools import pairwise
from typing import Annotated

import torch
from pydantic import Field as Option
from sononerf import Field
from torch import Tensor, nn


class Siren(Field):
    """A network whose non-linearities are sines (SIREN).

    Args:
        region ((2, 3), m): Lower and upper corner of the box.
        frequency ((F,), Hz): Frequencies of the answer.
        width, depth: Width and depth of the hidden layers.
        omega: Factor of the sines' arguments.
    """

    learning_rate = 1e-3
    costly = True

    def __init__(
        self,
        region: Tensor,
        frequency: Tensor,
        *,
        width: Annotated[int, Option(ge=8)] = 128,
        depth: Annotated[int, Option(ge=1)] = 3,
        omega: Annotated[float, Option(gt=0)] = 10.0,
    ) -> None:
        super().__init__(region, frequency)
        self.omega = omega
        sizes = [6] + [width] * depth
        self.layers = nn.ModuleList(nn.Linear(one, two) for one, two in pairwise(sizes))
        self.out = nn.Linear(width, len(frequency))
        for number, layer in enumerate(self.layers):
            bound = 1 / 6 if number == 0 else (6 / width) ** 0.5 / omega
            nn.init.uniform_(layer.weight, -bound, bound)

    @property
    def resolution(self) -> float:
        return float((self.region[1] - self.region[0]).max()) / 64

    def forward(self, positions: Tensor, directions: Tensor) -> Tensor:
        positions, directions = torch.broadcast_tensors(positions, directions)
        inside = self.inside(positions)
        size = (self.region[1] - self.region[0]).max() / 2
        place = (positions[inside] - self.region.mean(dim=0)) / size
        x = torch.cat((place, directions[inside]), dim=-1)
        for layer in self.layers:
            x = torch.sin(self.omega * layer(x))
        answer = self.out(x)
        silent = answer.new_zeros(*inside.shape, answer.shape[-1])
        return silent.index_put((inside,), answer)


make = Siren
