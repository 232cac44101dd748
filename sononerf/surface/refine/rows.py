# SPDX-License-Identifier: MIT
"""Parts of whole spectrograms, on the range slices that were rendered."""

from __future__ import annotations

import torch
from torch import Tensor


def on_rows(wholes: list[Tensor], row: Tensor, like: Tensor) -> Tensor:
    """Return the range slices of whole spectrograms from given rows on.

    Parameters
    ----------
    wholes : list of (E, R, F) float32
        One per pose.
    row : (P,) int64
        Each pose's first row; may lie before the axis.
    like : (P, E, W, F) Tensor
        Whose width and device the result has.

    Returns
    -------
    parts : (P, E, W, F) float32
        Zero beyond the axis.
    """
    width = like.shape[2]
    parts = []
    for whole, start in zip(wholes, row.tolist(), strict=True):
        first, last = max(start, 0), min(start + width, whole.shape[1])
        part = torch.zeros(whole.shape[0], width, whole.shape[2])
        if last > first:
            part[:, first - start : last - start] = whole[:, first:last]
        parts.append(part)
    return torch.stack(parts).to(like.device)
