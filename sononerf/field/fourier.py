# SPDX-License-Identifier: MIT
"""The paper's network: Fourier embedding, fully connected layers, skips by concatenation."""

from __future__ import annotations

import math
from typing import Annotated, Literal

import torch
from pydantic import Field as Option
from torch import Tensor, nn

from sononerf.field.field import Field


class _Affine(nn.Module):
    """What a batch normalisation amounts to when its statistics are never used."""

    def __init__(self, width: int) -> None:
        super().__init__()
        self.weight = nn.Parameter(torch.ones(width))
        self.bias = nn.Parameter(torch.zeros(width))

    def forward(self, x: Tensor) -> Tensor:
        return x * self.weight + self.bias


def _layers(start: int, widths: list[int]) -> nn.Sequential:
    layers: list[nn.Module] = []
    for width in widths:
        layers += [nn.Linear(start, width), nn.LeakyReLU(0.01)]
        start = width
    return nn.Sequential(*layers)


class FourierField(Field):
    r"""The Neural Reflectivity Field of the paper.

    ``inputs="direction"`` is the paper's: position and unit direction, six numbers, each as
    :math:`\sin(\sqrt2^k \pi x)`, k = 0..29 (180 values). ``inputs="angles"`` is the published
    code's: position, pitch and yaw, the numbers themselves beside their 30 sines, a second
    embedding :math:`\sin(2^k \pi x)`, k = 0..19, before the last layers, and three affine maps
    in place of batch normalisation: 546,324 parameters at 47 frequencies. In the code the
    angles are the *sensor's*; renderer ``shell`` passes them with ``direction="sensor"``.

    Parameters
    ----------
    region : (2, 3) float, m
        Lower and upper corner of the box, world frame.
    frequency : (F,) float, Hz
        Frequencies of the answer.
    inputs : {"direction", "angles"}
        Which of the two networks.
    octaves : int
        Number of sines per input, half an octave apart.
    width : int
        Width of the hidden layers.
    scale : float, 1/m
        What positions in metres are multiplied by before the embedding.
    rate : float
        What Adam starts with where the settings name no rate.

    References
    ----------
    .. [1] Jansen & Steckel, Biomimetics 9(6):321, 2024, section 2.
    """

    _first: Tensor
    _second: Tensor

    def __init__(
        self,
        region: Tensor,
        frequency: Tensor,
        *,
        inputs: Literal["direction", "angles"] = "direction",
        octaves: Annotated[int, Option(ge=1, le=64)] = 30,
        width: Annotated[int, Option(ge=8)] = 256,
        scale: Annotated[float, Option(gt=0)] = 1.0,
        rate: Annotated[float, Option(gt=0)] = 7e-4,
    ) -> None:
        super().__init__(region, frequency)
        self.inputs = inputs
        self.scale = scale
        self.learning_rate = rate
        count = 6 if inputs == "direction" else 5
        first = count * octaves + (0 if inputs == "direction" else count)
        second = first if inputs == "direction" else count * 20
        self.register_buffer("_first", math.pi * math.sqrt(2.0) ** torch.arange(octaves))
        self.register_buffer("_second", math.pi * 2.0 ** torch.arange(20))
        affine = (lambda n: _Affine(n)) if inputs == "angles" else (lambda _: nn.Identity())
        self.enter = affine(first)
        self.trunk = _layers(first, [width] * 4)
        self.middle = affine(width)
        self.branch = _layers(width + first, [width] * 2)
        self.leave = affine(width)
        self.head = _layers(width + second, [width, width // 2])
        self.out = nn.Linear(width // 2, 2 * len(frequency))

    @property
    def resolution(self) -> float:
        """One hundredth of the region's longest side, in metres: the network itself has none."""
        return float((self.region[1] - self.region[0]).max()) / 100

    def _numbers(self, positions: Tensor, directions: Tensor) -> Tensor:
        if self.inputs == "direction":
            return torch.cat((positions * self.scale, directions), dim=-1)
        look = -directions
        yaw = torch.atan2(look[..., 1], look[..., 0])
        pitch = -torch.asin(look[..., 2].clamp(-1.0, 1.0))  # positive looks down
        angles = torch.stack((pitch, yaw), dim=-1)
        return torch.cat((positions * self.scale, angles), dim=-1)

    @staticmethod
    def _sines(x: Tensor, frequencies: Tensor) -> Tensor:
        return torch.sin(x[..., None] * frequencies).flatten(-2)

    def forward(self, positions: Tensor, directions: Tensor) -> Tensor:
        """Return the complex reflectivity, (..., F); computed only inside the region."""
        shape = torch.broadcast_shapes(positions.shape, directions.shape)
        positions, directions = positions.expand(shape), directions.expand(shape)
        inside = self.inside(positions)
        x = self._numbers(positions[inside], directions[inside])
        first = self._sines(x, self._first)
        if self.inputs == "angles":
            first = torch.cat((x, first), dim=-1)
            second = self._sines(x, self._second)
        else:
            second = first
        hidden = self.middle(self.trunk(self.enter(first)))
        hidden = self.leave(self.branch(torch.cat((hidden, first), dim=-1)))
        real, imaginary = self.out(self.head(torch.cat((hidden, second), dim=-1))).chunk(2, dim=-1)
        response = torch.complex(real, imaginary)
        result = response.new_zeros(*shape[:-1], response.shape[-1])
        return result.index_put((inside,), response)
