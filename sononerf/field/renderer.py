# SPDX-License-Identifier: MIT
"""What every renderer promises, and gains that are looked up in tables."""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Any

import torch
import torch.nn.functional as F
from torch import Tensor, nn

from sononerf.field.field import Field
from sononerf.head.head import Head

Possible = Callable[[Tensor, float], Tensor]
"""Takes places (N, 3) and how far each speaks for its surroundings, in m; returns (N,) bool."""


def tensor(values: Any) -> Tensor:
    """Return numbers of a head as a tensor in single precision; a tensor stays as it is."""
    return values if isinstance(values, Tensor) else torch.tensor(values, dtype=torch.float32)


def look_up(table: Tensor, directions: Tensor) -> Tensor:
    """Interpolate gains over directions, bilinearly.

    Not differentiable in ``directions`` where they are fixed places and poses.

    Parameters
    ----------
    table : (C, L, A) or (E, C, L, A) float
        Gains over elevation (-90 to 90 degrees) and azimuth (-180 to 180), both ends included.
    directions : (..., 3) or (E, ..., 3) float
        Unit vectors in the head frame (x forward, y left, z up); for each of E tables its own.

    Returns
    -------
    gains : (..., C) or (E, ..., C) float
        In memory one channel after the other.
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
    """A field, poses and ranges in; the magnitude that both ears hear out.

    Parameters
    ----------
    region : (2, 3) float, m
        Lower and upper corner of the box that holds the field.
    head : Head
        What heard the spectra.
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
        self.log_gain = nn.Parameter(torch.zeros(()))
        self.register_buffer("points_evaluated", torch.zeros((), dtype=torch.long))

    @property
    def may_ask(self) -> bool:
        """Whether to ask the device for a number costs nothing.

        A GPU would wait for all that it was told before, so that a step has to do without.
        """
        return self.log_gain.device.type == "cpu"

    def advance(self, step: int, total: int) -> None:
        """Learn how far a fit has come; called before each training step.

        Parameters
        ----------
        step, total : int
            Number of the step, and of all.
        """

    def prepare(self, field: Field, possible: Possible | None, step: int) -> bool:
        """Choose where the field is evaluated next; called before each training step.

        Parameters
        ----------
        field : Field
            What is rendered.
        possible : callable or None
            Which places the echoes leave possible; asked at the first step and at refinements.
        step : int
            Number of the training step.

        Returns
        -------
        changed : bool
            Whether the gain no longer fits, so that :meth:`calibrate` has to follow.
        """
        del field, possible
        return step == 0

    @property
    def places_per_pose(self) -> int | None:
        """How many places a step evaluates per pose; None where that is not known beforehand."""
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

        Parameters
        ----------
        field : Field
            What is rendered.
        position : (P, 3) float, m
            Where the head is.
        rotation : (P, 3, 3) float
            Head to world.
        rows : (P, R) int
            Which range slices of each pose.
        bins : (B,) int or None
            Which frequencies; all where None.

        Returns
        -------
        magnitude : (P, E, R, B) float
            Linear.
        """
        raise NotImplementedError
