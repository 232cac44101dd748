# SPDX-License-Identifier: MIT
"""The paper's network: Fourier embedding, fully connected layers, skips by concatenation."""

from __future__ import annotations

import math
from typing import Annotated, Literal

import torch
from pydantic import Field as Option
from torch import Tensor, nn

from sononerf.errors import SettingsError
from sononerf.field.field import Field


class _Affine(nn.Module):
    """Affine map: a batch normalisation whose statistics are never used."""

    def __init__(self, width: int) -> None:
        super().__init__()
        self.weight = nn.Parameter(torch.ones(width))
        self.bias = nn.Parameter(torch.zeros(width))

    def forward(self, x: Tensor) -> Tensor:
        return x * self.weight + self.bias


def _layers(start: int, widths: list[int]) -> nn.Sequential:
    layers: list[nn.Module] = []
    for width in widths:
        layers += [nn.Linear(start, width), nn.LeakyReLU(0.01, inplace=True)]
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

    In: region ((2, 3), m), frequency ((F,), Hz), scale (1/m), spacing (m).

    References:
        .. [1] Jansen & Steckel, Biomimetics 9(6):321, 2024, section 2.
    """

    costly = True
    _first: Tensor
    _turns: Tensor
    _second: Tensor

    def __init__(
        self,
        region: Tensor,
        frequency: Tensor,
        *,
        inputs: Literal["direction", "angles"] = "direction",
        octaves: Annotated[int, Option(ge=1, le=64)] = 30,
        direction_octaves: Annotated[int, Option(ge=1, le=64)] | None = None,
        width: Annotated[int, Option(ge=8)] = 256,
        scale: Annotated[float, Option(gt=0)] = 1.0,
        spacing: Annotated[float, Option(gt=0, le=0.1)] | None = None,
        precision: Literal["float32", "bfloat16"] = "float32",
        rate: Annotated[float, Option(gt=0)] = 7e-4,
    ) -> None:
        super().__init__(region, frequency)
        self.inputs = inputs
        self.scale = scale
        self.spacing = spacing
        self.precision = precision
        self.learning_rate = rate
        if inputs == "angles" and direction_octaves is not None:
            raise SettingsError(
                "field.options.direction_octaves is of inputs direction, not of inputs angles; "
                "leave it out"
            )
        octaves_of_directions = direction_octaves or octaves
        first = 5 * (octaves + 1) if inputs == "angles" else 3 * (octaves + octaves_of_directions)
        second = 5 * 20 if inputs == "angles" else first
        self.register_buffer("_first", math.pi * math.sqrt(2.0) ** torch.arange(octaves))
        turns = math.pi * math.sqrt(2.0) ** torch.arange(octaves_of_directions)
        self.register_buffer(
            "_turns", turns, persistent=False
        )  # the settings of a file determine them
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
        """See ``spacing``."""
        return self.spacing or float((self.region[1] - self.region[0]).max()) / 100

    def _embedded(self, positions: Tensor, directions: Tensor) -> tuple[Tensor, Tensor]:
        """Return the inputs of the first layers, and of the last ones."""
        if self.inputs == "direction":
            place = self._sines(positions * self.scale, self._first)
            both = torch.cat((place, self._sines(directions, self._turns)), dim=-1)
            return both, both
        look = -directions
        yaw = torch.atan2(look[..., 1], look[..., 0])
        pitch = -torch.asin(look[..., 2].clamp(-1.0, 1.0))  # positive looks down
        x = torch.cat((positions * self.scale, torch.stack((pitch, yaw), dim=-1)), dim=-1)
        return torch.cat((x, self._sines(x, self._first)), dim=-1), self._sines(x, self._second)

    @staticmethod
    def _sines(x: Tensor, frequencies: Tensor) -> Tensor:
        return torch.sin(x[..., None] * frequencies).flatten(-2)

    def forward(self, positions: Tensor, directions: Tensor) -> Tensor:
        """Return the complex reflectivity, (..., F); computed only inside the region."""
        shape = torch.broadcast_shapes(positions.shape, directions.shape)
        positions, directions = positions.expand(shape), directions.expand(shape)
        inside = self.inside(positions)
        first, second = self._embedded(positions[inside], directions[inside])
        half = self.half_precision or self.precision == "bfloat16"
        with torch.autocast(positions.device.type, torch.bfloat16, half):
            hidden = self.middle(self.trunk(self.enter(first)))
            hidden = self.leave(self.branch(torch.cat((hidden, first), dim=-1)))
            answer = self.out(self.head(torch.cat((hidden, second), dim=-1)))
        response = torch.complex(*answer.to(positions.dtype).chunk(2, dim=-1))
        result = response.new_zeros(*shape[:-1], response.shape[-1])
        return result.index_put((inside,), response)
