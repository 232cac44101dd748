# SPDX-License-Identifier: MIT
"""Fine bins of range: what is laid into them, and how they are seen; gradients by hand."""

from __future__ import annotations

from functools import lru_cache
from typing import Any

import torch
import torch.nn.functional as F
from torch import Tensor


class Deposit(torch.autograd.Function):
    """Share (..., M) values out between the two bins next to where they lie, of (M,) rows.

    Where they lie is (M,), or alike for some of the leading dimensions. What lies outside the bins
    is lost. By hand, for autograd would take three times as many passes over all pairs.
    """

    @staticmethod
    def forward(ctx: Any, values: Tensor, at: Tensor, row: Tensor, rows: int, bins: int) -> Tensor:
        """Return what each bin of each row holds, (..., rows, bins)."""
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
        """Return what the windows see."""
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
        met = (blocks.mT @ seen).flatten(0, -4).sum(0).flatten(1)
        weight = met.new_zeros(len(met), taps + 1).index_add_(1, tap, met)[:, :taps]
        return spread, weight, None


@lru_cache(maxsize=8)
def _band(taps: int, step: int, where: torch.device) -> tuple[int, int, Tensor]:
    """Return slices of a tile, bins of a block, and which tap, or none, each bin meets."""
    tile = max(1, -(-taps // step) - 1)
    block = tile * step
    with torch.inference_mode(False):  # a prediction may come first, a fit afterwards
        tap = torch.arange(block)[:, None, None] - step * torch.arange(tile)
        tap = tap + block * torch.arange(2)[:, None]
        tap = torch.where((tap >= 0) & (tap < taps), tap, taps).reshape(-1)
        return tile, block, tap.to(where)
