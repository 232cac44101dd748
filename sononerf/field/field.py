# SPDX-License-Identifier: MIT
"""Interface of reflectivity fields."""

from __future__ import annotations

import math
from typing import Any

import torch
from torch import Tensor, nn
from torch.nn.functional import max_pool3d


def sphere_directions(count: int, like: Tensor) -> Tensor:
    """Return a Fibonacci lattice of unit vectors, (count, 3), of ``like``'s type and device."""
    k = torch.arange(count, dtype=like.dtype, device=like.device) + 0.5
    z = 1.0 - 2.0 * k / count
    azimuth = k * (math.pi * (3.0 - math.sqrt(5.0)))
    ring = (1.0 - z * z).clamp_min(0.0).sqrt()
    return torch.stack((ring * azimuth.cos(), ring * azimuth.sin(), z), dim=-1)


class Field(nn.Module):
    """Pressure reflectivity per frequency of a place, towards a direction; zero outside a box.

    Args:
        region ((2, 3), m): Lower and upper corner of the box, world frame.
        frequency ((F,), Hz): Frequencies of the answer.
    """

    region: Tensor
    frequency: Tensor
    occupancy: Tensor
    cell: Tensor
    learning_rate: float = 1e-3
    """Initial learning rate of Adam where the settings name none."""
    costly: bool = False
    """True if one place needs so many operations that threads always save time."""
    half_precision: bool = False
    """Whether layers may multiply in half precision; the module sets it."""

    def __init__(self, region: Tensor, frequency: Tensor) -> None:
        super().__init__()
        self.register_buffer("region", region.clone())
        self.register_buffer("frequency", frequency.clone())
        self.register_buffer("occupancy", torch.ones(1, 1, 1, dtype=torch.bool))
        self.register_buffer("cell", (region[1] - region[0]).clone() * 2)
        self._asked: tuple[Tensor, Tensor, Tensor | None] | None = None  # see outside

    def _load_from_state_dict(self, state_dict: dict[str, Any], prefix: str, *rest: Any) -> None:
        # The fit determines the map of occupied places and its resolution; a loaded map replaces
        # ours.
        if prefix + "occupancy" in state_dict:
            self.occupancy = self.occupancy.new_zeros(state_dict[prefix + "occupancy"].shape)
        super()._load_from_state_dict(state_dict, prefix, *rest)

    @torch.no_grad()
    def keep(self, places: Tensor, spacing: float) -> None:
        """Set the field to zero, from now on, at all points that are near none of the places.

        Args:
            places ((N, 3), m): Vertices of a lattice that may hold something.
            spacing (m): Spacing of that lattice.
        """
        cell = self.resolution
        size = ((self.region[1] - self.region[0]) / cell).ceil().long() + 1
        near = self.region.new_zeros([int(n) for n in size])
        index = ((places - self.region[0]) / cell).round().long()
        index = index.clamp_min(0).minimum(size - 1)
        near[index[:, 0], index[:, 1], index[:, 2]] = 1.0
        half_width = math.ceil(spacing / cell / 2 - 1e-6) if spacing > 1.001 * cell else 0
        # One axis after the other: a cube at once would take reach² times as long.
        for axis in range(3):
            size_of = [2 * half_width + 1 if axis == a else 1 for a in range(3)]
            edge = [half_width if axis == a else 0 for a in range(3)]
            near = max_pool3d(near[None, None], size_of, 1, edge)[0, 0]
        self.occupancy = near > 0
        self.cell = torch.full_like(self.cell, cell)

    def advance(self, step: int, total: int) -> None:
        """Note the progress of the fit, before each training step; a field may change with it.

        Such changes have to be kept in a buffer, so that a loaded field is the fitted one.

        Args:
            step: Number of the training step, from 0.
            total: Number of steps of the fit.
        """
        del step, total

    @property
    def resolution(self) -> float:
        """Spacing in metres that resolves the field."""
        raise NotImplementedError

    def forward(self, positions: Tensor, directions: Tensor) -> Tensor:
        """Return the reflectivity.

        Differentiable in the parameters.

        Args:
            positions ((..., 3), m): Places, world frame.
            directions (..., 3): Unit vectors from each place to the emitter, world frame.

        Returns:
            reflectivity ((..., F) float or complex): Pressure reflectivity; zero outside the
                region.
        """
        raise NotImplementedError

    def select(self, positions: Tensor, directions: Tensor, bins: Tensor | None) -> Tensor:
        """Return the reflectivity at some of the frequencies.

        Args:
            positions ((N, 3), m): Places, world frame.
            directions (..., N, 3): Unit vectors to the emitter, for any number of poses at once.
            bins ((B,) int or None): Indices of the frequencies; all by default.

        Returns:
            reflectivity: (..., N, B) float or complex.
        """
        response: Tensor = self(positions.expand(directions.shape), directions)
        return response if bins is None else response[..., bins]

    def code(self, positions: Tensor) -> Tensor | None:
        """Return the field's own parameters of places, or None if it has none.

        :meth:`audible` and :meth:`echo` take them, so that they are computed once for both.

        Args:
            positions ((N, 3), m): Places, world frame.

        Returns:
            code: (N, C) or None.
        """
        del positions
        return None

    def code_of_lattice(self, lattice: Tensor, which: Tensor | None) -> Tensor | None:
        """Do as :meth:`code`, for places that are evaluated repeatedly.

        Args:
            lattice ((L, 3), m): The same tensor as long as the places are the same: the way of
                reading it may be kept.
            which ((N,) int or None): Indices of the places; all by default.

        Returns:
            code: (N, C) or None.
        """
        return self.code(lattice if which is None else lattice[which])

    @torch.no_grad()
    def audible(self, positions: Tensor, sources: Tensor, code: Tensor | None = None) -> Tensor:
        """Return the mask of the places that send echoes to emitters.

        Args:
            positions ((N, 3), m): Places, world frame.
            sources ((P, 3), m): Emitters of several poses.
            code ((N, C) or None): Code of :meth:`code`; found out by default.

        Returns:
            audible (P, N): False only where the echo may be left out.
        """
        del code
        return positions.new_ones(len(sources), len(positions), dtype=torch.bool)

    def echo(
        self,
        positions: Tensor,
        directions: Tensor,
        bins: Tensor | None,
        place: Tensor | None = None,
        code: Tensor | None = None,
    ) -> tuple[Tensor, Tensor]:
        """Return the echoes of places, and how much nearer than the places they arise.

        Args:
            positions ((N, 3), m): Places, world frame.
            directions (M, 3): Unit vectors to the emitter.
            bins ((B,) int or None): Indices of the frequencies; all by default.
            place ((M,) int or None): Index of the place of each direction, so that a place is
                evaluated once for all its directions; each has its own place by default.
            code ((N, C) or None): Code of :meth:`code`; found out by default.

        Returns:
            reflectivity ((M, B) float or complex): As in :meth:`select`.
            lead ((M,), m): A place that stands for a piece of curved surface answers off its axis
                from another point of it, which lies this much nearer.
        """
        del code
        there = positions if place is None else positions[place]
        return self.select(there, directions, bins), torch.zeros_like(directions[:, 0])

    def inside(self, positions: Tensor) -> Tensor:
        """Return the mask (...,) of the places in the region, its faces included."""
        # Places that were computed to lie on a face may miss it by a rounding.
        slack = 4 * torch.finfo(positions.dtype).eps * self.region.abs().max()
        above, below = positions >= self.region[0] - slack, positions <= self.region[1] + slack
        within = (above & below).all(dim=-1)
        size = torch.tensor(self.occupancy.shape, device=positions.device)
        index = ((positions - self.region[0]) / self.cell).round().long()
        index = index.clamp_min(0).minimum(size - 1)
        return within & self.occupancy[index[..., 0], index[..., 1], index[..., 2]]

    def outside(self, lattice: Tensor) -> Tensor | None:
        """Return where places lie outside the region, for places that are evaluated repeatedly.

        Args:
            lattice ((L, 3), m): The same tensor as long as the places are the same: the answer is
                kept.

        Returns:
            outside ((L,) bool or None): None where all lie inside, so that nothing need be made
                zero.
        """
        directions = self._asked
        if (
            directions is None
            or directions[0] is not lattice
            or directions[1] is not self.occupancy
        ):
            with torch.inference_mode(False):
                outside = ~self.inside(lattice)
            self._asked = directions = (lattice, self.occupancy, outside if outside.any() else None)
        return directions[2]

    @torch.no_grad()
    def energy(self, positions: Tensor, directions: int) -> Tensor:
        """Return each place's energy over all directions.

        Args:
            positions ((N, 3), m): Places, world frame.
            directions: Size of the spherical lattice that is summed over.

        Returns:
            energy (N,): Mean over directions of the power summed over frequencies.
        """
        lattice = sphere_directions(directions, positions)
        energy = positions.new_zeros(positions.shape[0])
        for direction in lattice:
            response = self.select(positions, direction.expand(positions.shape), None)
            energy += response.abs().square().sum(dim=-1) / directions
        return energy

    @torch.no_grad()
    def loudness(self, positions: Tensor, directions: int) -> Tensor:
        """Return the paper's volume: magnitudes summed over directions and frequencies, (N,).

        References:
            .. [1] Jansen & Steckel, Biomimetics 9(6):321, 2024, equations 18 and 19.
        """
        total = positions.new_zeros(positions.shape[0])
        for direction in sphere_directions(directions, positions):
            total += self.select(positions, direction.expand(positions.shape), None).abs().sum(-1)
        return total


def lattice_over(region: Tensor, spacing: float) -> Tensor:
    """Return the vertices of a cubic lattice over a box, (N, 3), from its lower corner."""
    steps = [
        region[0, a]
        + spacing
        * torch.arange(
            math.floor(float(region[1, a] - region[0, a]) / spacing + 1e-6) + 1,
            dtype=region.dtype,
            device=region.device,
        )
        for a in range(3)
    ]
    return torch.stack(torch.meshgrid(*steps, indexing="ij"), dim=-1).reshape(-1, 3)
