# SPDX-License-Identifier: MIT
"""The built-in fields: the paper's network, and grids of several resolutions."""

from __future__ import annotations

import math
import warnings
from typing import Annotated, Any, Literal

import torch
import torch.nn.functional as F
from pydantic import Field as Option
from torch import Tensor, nn

from sononerf.errors import SettingsError
from sononerf.field.field import Field
from sononerf.field.lobe import CODE, LobeField


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


MIN_VERTEX_WEIGHT = 1e-5
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
                read = factor > MIN_VERTEX_WEIGHT
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
        """Return True if this matrix is of these places and of such grids."""
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
