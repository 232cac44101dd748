# SPDX-License-Identifier: MIT
"""Interface of renderers; gains from tables; range profiles on bins; the paper's renderer."""

from __future__ import annotations

import math
from collections.abc import Callable
from functools import lru_cache
from typing import Annotated, Any, Literal

import torch
import torch.nn.functional as F
from pydantic import Field as Option
from torch import Tensor, nn

from sononerf.field.field import Field, sphere_directions
from sononerf.head.head import Head

Possible = Callable[[Tensor, float], Tensor]
"""Takes places (N, 3) and how far each speaks for its surroundings, in m; returns (N,) bool."""


def tensor(values: Any) -> Tensor:
    """Return numbers of a head as a tensor in single precision; a tensor stays as it is."""
    return values if isinstance(values, Tensor) else torch.tensor(values, dtype=torch.float32)


def look_up(table: Tensor, directions: Tensor) -> Tensor:
    """Interpolate gains over directions, bilinearly.

    Not differentiable in ``directions`` where they are fixed places and poses.

    In: table ((C, L, A) or (E, C, L, A)), directions ((..., 3) or (E, ..., 3)). Out: gains ((...,
    C) or (E, ..., C)).
    """
    x, y, z = directions.movedim(-1, 0).contiguous()  # side by side, for the sake of speed
    azimuth = torch.atan2(y, x) / math.pi
    elevation = torch.asin(z.clamp(-1.0, 1.0)) * (2 / math.pi)
    several = table.ndim == 4
    tables = table if several else table[None]
    grid = torch.stack((azimuth, elevation), dim=-1).reshape(len(tables), 1, -1, 2)
    read = F.grid_sample(tables, grid, align_corners=True, padding_mode="border")
    shape = directions.shape[:-1]
    if several:
        return read.reshape(*read.shape[:2], *shape[1:]).movedim(1, -1)
    return read.reshape(len(table), *shape).movedim(0, -1)


class Renderer(nn.Module):
    """Renderer: maps a field, poses and ranges to the magnitude at both ears.

    Args:
        region ((2, 3), m): Lower and upper corner of the box that holds the field.
        head: The head that heard the spectra.

    Attributes:
        points_evaluated: Number of points at which the field was evaluated in training. Pictures
            and validation do not count, so that the number does not depend on when they are drawn.
        support (2, 3): Point (m) and unit normal of the plane that mirrors sound; None where there
            is none. A renderer that does not know images may leave it out.
    """

    whole_poses: bool = True
    """Whether a batch is whole poses (all ranges) or single range slices of many poses."""

    region: Tensor
    frequency: Tensor
    range: Tensor
    beam: Tensor
    ears: Tensor
    emitter: Tensor
    ear_positions: Tensor
    points_evaluated: Tensor
    support: Tensor | None

    def __init__(self, region: Tensor, head: Head) -> None:
        super().__init__()
        self.register_buffer("region", region.clone())
        for name, values in (
            ("frequency", head.frequency),
            ("range", head.range),
            ("beam", head.row_gains.beam),
            ("ears", head.row_gains.ears),
            ("emitter", head.emitter),
            ("ear_positions", head.receivers),
        ):
            whole = tensor(values).clone(memory_format=torch.contiguous_format)
            self.register_buffer(name, whole)
        plane = head.plane
        known = None if plane is None else tensor([plane.point, plane.normal])
        # Not part of the state: the head says it.
        self.register_buffer("support", known, persistent=False)
        self.log_gain = nn.Parameter(torch.zeros(()))
        self.register_buffer("points_evaluated", torch.zeros((), dtype=torch.long))

    @property
    def on_cpu(self) -> bool:
        """True if reading a scalar does not synchronise the device.

        Reading a scalar lets a GPU finish all queued work first, so a step must do without.
        """
        return self.log_gain.device.type == "cpu"

    def advance(self, step: int, total: int) -> None:
        """Learn how far a fit has come; called before each training step.

        Args:
            step, total: Number of the step, and of all.
        """

    def prepare(self, field: Field, possible: Possible | None, step: int) -> bool:
        """Choose where the field is evaluated next; called before each training step.

        Args:
            field: The field to render.
            possible: Test of places against the echoes; evaluated at the first step and at
                refinements.
            step: Number of the training step.

        Returns:
            changed: Whether the gain no longer fits, so that :meth:`calibrate` has to follow.
        """
        del field, possible
        return step == 0

    @property
    def places_per_pose(self) -> int | None:
        """Number of places that a step evaluates per pose; None if it is not known beforehand."""
        return None

    @torch.no_grad()
    def calibrate(self, predicted: Tensor, measured: Tensor) -> None:
        """Set the gain so that prediction and measurement have the same energy."""
        ratio = measured.square().sum() / predicted.square().sum().clamp_min(1e-30)
        self.log_gain.add_(0.5 * ratio.clamp_min(1e-30).log())

    def forward(
        self,
        field: Field,
        position: Tensor,
        rotation: Tensor,
        rows: Tensor,
        bins: Tensor | None = None,
    ) -> Tensor:
        """Render.

        Args:
            field: The field to render.
            position ((P, 3), m): Place of the head.
            rotation (P, 3, 3): Head to world.
            rows (P, R): Indices of the range slices of each pose.
            bins ((B,) int or None): Indices of the frequencies; all by default.

        Returns:
            magnitude (P, E, R, B): Linear.
        """
        raise NotImplementedError


class Deposit(torch.autograd.Function):
    """Distribute values (..., M) over the two bins next to their positions, in rows (M,).

    Positions are (M,), or alike for some of the leading dimensions. Values outside the bins are
    lost. The gradient is written by hand, because autograd takes three times as many passes over
    all pairs.
    """

    @staticmethod
    def forward(ctx: Any, values: Tensor, at: Tensor, row: Tensor, rows: int, bins: int) -> Tensor:
        """Return the content of each bin of each row, (..., rows, bins)."""
        left = at.floor()
        far = at - left
        within = (left >= 0) & (left < bins - 1)
        near = (1 - far) * within
        far = far * within
        index = (row * bins + left.long().clamp_(0, bins - 2)).expand(values.shape)
        total = values.new_zeros(*values.shape[:-1], rows * bins)
        total.scatter_add_(-1, index, values * near)
        total[..., 1:].scatter_add_(-1, index, values * far)
        ctx.save_for_backward(values, near, far, index)
        return total.unflatten(-1, (rows, bins))

    @staticmethod
    def backward(ctx: Any, *gradients: Tensor) -> tuple[Tensor | None, ...]:
        """Return the gradients towards the values, and where they lie."""
        values, near, far, index = ctx.saved_tensors
        gradient = gradients[0].flatten(-2)
        here, next_one = gradient.gather(-1, index), gradient[..., 1:].gather(-1, index)
        along = None
        if ctx.needs_input_grad[1]:
            slope = ((next_one - here).mul_(values)).sum_to_size(near.shape)
            along = slope * (near + far)  # 1 within the bins
        return here.mul_(near).addcmul_(next_one, far), along, None, None, None


class Window(torch.autograd.Function):
    """See (..., B, P, K) profiles through (B, W) windows, a step at a time: (..., B, P, R).

    The steps have to end where the profiles do: K = (R - 1) step + W. As many slices as
    see no more than two blocks of a profile are one tile, and a product with a band matrix: a CPU
    is slower with convolutions of one channel each.
    """

    @staticmethod
    def forward(ctx: Any, profiles: Tensor, kernel: Tensor, step: int) -> Tensor:
        """Return the power in the windows."""
        *lead, poses, length = profiles.shape
        taps = kernel.shape[1]
        slices = (length - taps) // step + 1
        tile, block, tap = _band(taps, step, kernel.device)
        tiles = -(-slices // tile)
        band = F.pad(kernel, (0, 1)).index_select(1, tap).reshape(-1, block, 2 * tile)
        blocks = F.pad(profiles, (0, (tiles + 1) * block - length))
        blocks = blocks.reshape(*lead, poses * (tiles + 1), block)
        seen = (blocks @ band).reshape(*lead, poses, tiles + 1, 2, tile)
        ctx.save_for_backward(blocks, band, tap)
        ctx.sizes = length, taps, slices
        found = seen[..., :-1, 0, :] + seen[..., 1:, 1, :]
        return found.flatten(-2)[..., :slices]

    @staticmethod
    def backward(ctx: Any, *gradients: Tensor) -> tuple[Tensor | None, ...]:
        """Return the gradients towards profiles and windows."""
        blocks, band, tap = ctx.saved_tensors
        length, taps, slices = ctx.sizes
        (gradient,) = gradients
        *lead, poses, _ = gradient.shape
        tile = band.shape[2] // 2
        tiles = blocks.shape[-2] // poses - 1
        part = F.pad(gradient, (0, tiles * tile - slices)).unflatten(-1, (tiles, tile))
        seen = gradient.new_zeros(*lead, poses, tiles + 1, 2, tile)
        seen[..., :-1, 0, :] = part
        seen[..., 1:, 1, :] = part
        seen = seen.reshape(*lead, poses * (tiles + 1), 2 * tile)
        spread = (seen @ band.mT).reshape(*lead, poses, -1)[..., :length]
        counts = (blocks.mT @ seen).flatten(0, -4).sum(0).flatten(1)
        weight = counts.new_zeros(len(counts), taps + 1).index_add_(1, tap, counts)[:, :taps]
        return spread, weight, None


@lru_cache(maxsize=8)
def _band(taps: int, step: int, where: torch.device) -> tuple[int, int, Tensor]:
    """Return slices of a tile, bins of a block, and the tap of each bin, if any."""
    tile = max(1, -(-taps // step) - 1)
    block = tile * step
    with torch.inference_mode(False):  # a prediction may come first, a fit afterwards
        tap = torch.arange(block)[:, None, None] - step * torch.arange(tile)
        tap = tap + block * torch.arange(2)[:, None]
        tap = torch.where((tap >= 0) & (tap < taps), tap, taps).reshape(-1)
        return tile, block, tap.to(where)


class ShellRenderer(Renderer):
    r"""Equation 17 of the paper.

    .. math:: S_e(f, r) = \frac{g\, c_f}{D} \Big| \sum_d F(p + r d, v)\, E_e(d, f) \Big|

    The equation's phase factor depends on frequency and range alone and cancels in the
    magnitude. There is no spreading, no absorption and no delay between the ears, as there.
    The gain g is learned. Of a call spectrum c the equation knows nothing: it is 1, or learned as
    the published code does. Places outside the field's region are zero
    and are not computed.

    In: region ((2, 3), m).

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
        self.direction_input = direction
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
        """Render; see the base class. Differentiable in the field and in the learned parameters."""
        transfer = self.transfer if bins is None else self.transfer[..., bins]
        spectrum = self.log_spectrum if bins is None else self.log_spectrum[bins]
        world = torch.einsum("pij,dj->pdi", rotation, self.directions)  # (P, D, 3)
        places = position[:, None, None] + self.range[rows][..., None, None] * world[:, None]
        directions = (
            -world
            if self.direction_input == "incidence"
            else -rotation[:, None, :, 0].expand(world.shape)
        )
        directions = directions[:, None].expand(places.shape)
        inside = field.inside(places)  # (P, R, D)
        if self.training:
            self.points_evaluated += inside.sum()
        slice_index, direction_index = inside.flatten(0, 1).nonzero(as_tuple=True)
        response = field.select(places[inside], directions[inside], bins)  # (N, B)
        sums = []
        for ear in transfer:
            echo = response * ear[direction_index]
            total = echo.new_zeros(inside.shape[0] * inside.shape[1], echo.shape[-1])
            sums.append(total.index_add(0, slice_index, echo))
        total = torch.stack(sums)  # (E, P R, B)
        # The magnitude's gradient at exactly zero is not defined; a field that is zero there
        # has none. The offset is subtracted again, so that zero stays exactly zero.
        power = total.real.square() + total.imag.square() if total.is_complex() else total.square()
        magnitude = power / ((power + 1e-20).sqrt() + 1e-10)
        scale = (self.log_gain + spectrum).exp() / len(self.directions)
        shape = (len(transfer), inside.shape[0], inside.shape[1], -1)
        return (magnitude * scale).reshape(shape).transpose(0, 1)
