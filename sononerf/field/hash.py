# SPDX-License-Identifier: MIT
"""A multi-resolution hash grid with a physics-shaped head, for large or fine scenes."""

from __future__ import annotations

import math
from typing import Annotated, Any

import torch
import torch.nn.functional as F
from pydantic import Field as Option
from torch import Tensor, nn

from sononerf.field.field import Field
from sononerf.field.grid import LOG_STRENGTH_FLOOR, QUIETEST

PRIMES = (1, 2654435761, 805459861)
"""What the numbers of a vertex along x, y and z are multiplied by; Müller et al. 2022, eq. 4."""
CHUNK = 65_536
"""How many places are read out at once."""
CALM = 0.1
"""How far Adam's step moves a weight that all places share, beside one of a single vertex."""


class _Blend(torch.autograd.Function):
    """Weighted sums of a table's rows; torch's own gradient of them takes several times as long."""

    @staticmethod
    def forward(ctx: Any, table: Tensor, entries: Tensor, weights: Tensor) -> Tensor:
        ctx.save_for_backward(entries, weights)
        ctx.shape = table.shape
        return F.embedding_bag(entries.T, table, mode="sum", per_sample_weights=weights.T)

    @staticmethod
    def backward(ctx: Any, *gradients: Tensor) -> tuple[Tensor, None, None]:
        entries, weights = ctx.saved_tensors
        rows, columns = ctx.shape
        total = weights.new_zeros(columns, rows)
        for row, gradient in zip(total, gradients[0].unbind(1), strict=True):
            row.scatter_add_(0, entries.reshape(-1), (weights * gradient).reshape(-1))
        return total.T, None, None


class _Layer(nn.Linear):
    """A layer that moves calmly: with steps as large as a vertex takes, a whole field may die."""

    def __init__(self, start: int, end: int) -> None:
        super().__init__(start, end)
        with torch.no_grad():
            self.weight.div_(CALM)
            self.bias.zero_()

    def forward(self, x: Tensor) -> Tensor:
        return F.linear(x, self.weight * CALM, self.bias * CALM)


class HashField(Field):
    r"""Lobes read out of a multi-resolution hash grid by a small network.

    .. math::
        \rho(x, u, f) = \exp\big(a(x) + \kappa_f (m(x) \cdot u - |m(x)|) + s_f
        + c(x) \cdot b_f\big)

    Each level is a cubic lattice with a feature vector per vertex. A level whose vertices fit
    into the table has one entry for each of them; in a finer one vertices share entries, by a
    hash of their numbers [1]_. The levels' features, interpolated trilinearly, go through two
    hidden layers, and past them, into the log strength :math:`a`, the lobe vector :math:`m` (along
    the surface normal, as long as the lobe is concentrated) and the coefficients :math:`c` of a
    correction in a basis of ``rank`` spectra :math:`b`. :math:`\kappa_f` sharpens the lobe with
    frequency and :math:`s_f` is one spectrum for the whole field. A fit begins with the coarsest
    level; the finer ones follow one after the other.

    Parameters
    ----------
    region : (2, 3) float, m
        Lower and upper corner of the box, world frame.
    frequency : (F,) float, Hz
        Frequencies of the answer.
    finest : float, m
        Vertex spacing of the finest level.
    growth : float
        How much coarser each level is than the next.
    levels : int
        Number of levels.
    features : int
        Numbers per vertex and level.
    log2_entries : int
        A level has at most two to the power of this many entries.
    width : int
        Width of the hidden layers.
    rank : int
        Number of spectra of the correction; at most one less than there are frequencies.
    released : float
        The part of the fit after which all levels take part.

    References
    ----------
    .. [1] T. Müller, A. Evans, C. Schied, A. Keller, "Instant neural graphics primitives with a
       multiresolution hash encoding", ACM Transactions on Graphics 41(4):102, 2022.
    """

    learning_rate = 0.05
    knows_directions = True
    progress: Tensor
    _last: Tensor
    _factors: Tensor

    def __init__(
        self,
        region: Tensor,
        frequency: Tensor,
        *,
        finest: Annotated[float, Option(gt=0)] = 0.002,
        growth: Annotated[float, Option(ge=1.1, le=4)] = 2.0,
        levels: Annotated[int, Option(ge=1, le=24)] = 5,
        features: Annotated[int, Option(ge=1, le=16)] = 4,
        log2_entries: Annotated[int, Option(ge=3, le=24)] = 17,
        width: Annotated[int, Option(ge=1, le=256)] = 32,
        rank: Annotated[int, Option(ge=0, le=64)] = 6,
        released: Annotated[float, Option(gt=0, le=1)] = 0.4,
    ) -> None:
        super().__init__(region, frequency)
        self.spacings = [finest * growth ** (levels - 1 - level) for level in range(levels)]
        self.released = released
        self._mask = 2**log2_entries - 1
        extent = (region[1] - region[0]).double().tolist()
        self._first, self._shared = [0], []
        last, factors = [], []
        for spacing in self.spacings:
            size = [max(math.ceil(side / spacing - 1e-6), 1) + 1 for side in extent]
            vertices = math.prod(size)
            self._shared.append(vertices > 2**log2_entries)
            self._first.append(self._first[-1] + min(vertices, 2**log2_entries))
            last.append([count - 1 for count in size])
            factors.append(PRIMES if self._shared[-1] else (1, size[0], size[0] * size[1]))
        # All follow from the region and the options, so they need not be kept.
        self.register_buffer("_last", torch.tensor(last), persistent=False)
        self.register_buffer("_factors", torch.tensor(factors), persistent=False)
        self.register_buffer("progress", torch.ones(()))
        self.table = nn.Parameter(torch.zeros(self._first[-1], features).uniform_(-1e-4, 1e-4))
        rank = min(rank, len(frequency) - 1)
        self.hidden = nn.Sequential(
            _Layer(levels * features, width), nn.ReLU(), _Layer(width, width), nn.ReLU()
        )
        self.out = _Layer(width + levels * features, 4 + rank)
        with torch.no_grad():
            # At first each level adds to strength and lobe as if it held nothing else.
            self.out.weight[:, width:] = torch.eye(4 + rank, features).repeat(1, levels) / CALM
        self.spectrum = nn.Parameter(torch.zeros(len(frequency)))
        self.sharpness = nn.Parameter(torch.zeros(len(frequency)))
        # Cosines over the frequencies to begin with, the slowest first.
        phase = (torch.arange(len(frequency)) + 0.5) * (math.pi / len(frequency))
        self.basis = nn.Parameter(torch.cos(torch.arange(1, rank + 1)[:, None] * phase))

    @property
    def resolution(self) -> float:
        """Vertex spacing of the finest level in metres."""
        return self.spacings[-1]

    def advance(self, step: int, total: int) -> None:
        """Release levels; how far that has come is kept with the weights."""
        self.progress.fill_(step / total)

    def release(self) -> Tensor:
        """Return how far each level takes part, (L,), from the coarsest to the finest."""
        behind = torch.arange(len(self._last), device=self.progress.device)
        reached = self.progress / self.released * (len(self._last) - 1)
        return (1 + reached - behind).clamp(0.0, 1.0)

    def corners(self, positions: Tensor, level: int) -> tuple[Tensor, Tensor]:
        """Return the eight vertices around each place as entries of the table, and their weights.

        Parameters
        ----------
        positions : (N, 3) float, m
            Places, world frame; those outside the lattice are moved to its faces.
        level : int
            Counted from the coarsest.

        Returns
        -------
        entries : (8, N) int
            Rows of the table.
        weights : (8, N) float
            Trilinear; they sum to one.
        """
        last = self._last[level]
        unit = ((positions - self.region[0]) / self.spacings[level]).clamp_min(0).minimum(last)
        cell = unit.long().minimum(last - 1)
        upper = (unit - cell).T
        number = cell.T * self._factors[level][:, None]
        number = torch.stack((number, number + self._factors[level][:, None]), dim=1)
        x, y, z = number[0, :, None, None], number[1, None, :, None], number[2, None, None, :]
        entry = (x ^ y ^ z) & self._mask if self._shared[level] else x + y + z  # (2, 2, 2, N)
        weight = torch.stack((1 - upper, upper), dim=1)
        x, y, z = weight[0, :, None, None], weight[1, None, :, None], weight[2, None, None, :]
        return (entry + self._first[level]).reshape(8, -1), (x * y * z).reshape(8, -1)

    def encode(self, positions: Tensor) -> Tensor:
        """Interpolate the features of all levels at (N, 3) places: (N, L * features)."""
        corners = [self.corners(positions, level) for level in range(len(self._last))]
        entries, weights = (torch.cat(part, dim=1) for part in zip(*corners, strict=True))
        read: Tensor = _Blend.apply(self.table, entries, weights)  # (L * N, features)
        read = read.reshape(len(corners), len(positions), self.table.shape[1])
        return (read * self.release()[:, None, None]).transpose(0, 1).flatten(1)

    def code(self, positions: Tensor) -> Tensor:
        """Return log strength, lobe vector and coefficients of (N, 3) places, (N, 4 + rank)."""
        features = self.encode(positions)
        code: Tensor = self.out(torch.cat((self.hidden(features), features), dim=1))
        return code

    def _log_strength(self, code: Tensor, bins: Tensor | slice) -> Tensor:
        """Return the log reflectivity along the lobe's axis, (N, B)."""
        correction = code[:, 4:] @ self.basis[:, bins] + self.spectrum[bins]
        return code[:, :1].clamp_min(LOG_STRENGTH_FLOOR) + correction

    def select(self, positions: Tensor, directions: Tensor, bins: Tensor | None) -> Tensor:
        """Return the reflectivity of (N, 3) places towards (..., N, 3) directions."""
        return self._response(self.code(positions), self.inside(positions), directions, bins)

    def echo(
        self,
        positions: Tensor,
        directions: Tensor,
        bins: Tensor | None,
        place: Tensor | None = None,
    ) -> tuple[Tensor, Tensor]:
        """Return the reflectivity, (M, B), and no lead; see the base class."""
        code, inside = self.code(positions), self.inside(positions)
        if place is not None:
            code, inside = code[place], inside[place]
        response = self._response(code, inside, directions, bins)
        return response, torch.zeros_like(directions[:, 0])

    def _response(
        self, code: Tensor, inside: Tensor, directions: Tensor, bins: Tensor | None
    ) -> Tensor:
        which = slice(None) if bins is None else bins
        lobe = code[:, 1:4]
        # The small number keeps the gradient finite where there is no lobe.
        tilt = (directions * lobe).sum(-1) - (lobe.square().sum(-1) + 1e-6).sqrt()
        away = tilt[..., None] * self.sharpness[which].exp()
        response = (self._log_strength(code, which) + away).exp()
        return response * inside[:, None]

    @torch.no_grad()
    def audible(self, positions: Tensor, directions: Tensor) -> Tensor:
        """Return which of (N, 3) places answer towards which (P, N, 3) directions, (P, N) bool."""
        lobe = self.code(positions)[:, 1:4]
        tilt = (directions * lobe).sum(-1) - lobe.norm(dim=-1)
        return tilt * self.sharpness.min().exp() > QUIETEST

    def forward(self, positions: Tensor, directions: Tensor) -> Tensor:
        """Return the reflectivity, (..., F) float."""
        shape = torch.broadcast_shapes(positions.shape, directions.shape)
        flat = positions.expand(shape).reshape(-1, 3)
        response = self.select(flat, directions.expand(shape).reshape(-1, 3), None)
        return response.reshape(*shape[:-1], response.shape[-1])

    @torch.no_grad()
    def oriented(self, positions: Tensor, directions: int) -> tuple[Tensor, Tensor]:
        r"""Return energy and axis from the lobe itself, exact where a lattice would be too coarse.

        The mean over the sphere of :math:`e^{2k(\cos - 1)}` is :math:`(1 - e^{-4k})/(4k)`.
        """
        del directions
        # One part after the other: eight corners per level and place take room.
        parts = [self._oriented(part) for part in positions.split(CHUNK)]
        energy, axis = (torch.cat(part) for part in zip(*parts, strict=True))
        return energy * self.inside(positions), axis

    def _oriented(self, positions: Tensor) -> tuple[Tensor, Tensor]:
        code = self.code(positions)
        lobe = code[:, 1:4]
        length = lobe.norm(dim=-1, keepdim=True)
        concentration = length * self.sharpness.exp()
        mean = -torch.expm1(-4 * concentration) / (4 * concentration).clamp_min(1e-12)
        mean = torch.where(concentration > 1e-6, mean, torch.ones_like(mean))
        power = (2 * self._log_strength(code, slice(None))).exp() * mean
        return power.sum(-1), lobe / length.clamp_min(1e-12)
