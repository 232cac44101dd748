# SPDX-License-Identifier: MIT
"""What every reader of recordings gives back."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from sononerf.recordings.columns import Columns


@dataclass(frozen=True, eq=False)
class Recording:
    """Pings as they were recorded, and the table that says where each of them was.

    Attributes
    ----------
    path : Path
        Where it was read from, for messages.
    sampling_rate : float
        Hz.
    labels : tuple of str
        What each of the P pings is called in messages.
    emission : (P,) float, s
        When the call of each ping left, counted from the first sample that :attr:`read` gives.
        Negative where the recording began later.
    read : callable
        Takes the number of a ping and returns its samples (E, S) as they are on disk: integers
        reach from one end of their type to the other, floats have the user's unit.
    columns : Columns
        Poses as in the table, in its own frame.
    settings : dict
        What the source itself says of ``air``, ``ears`` and ``call``: plain data by section.
    notes : tuple of str
        What was understood and may surprise, one line each.
    """

    path: Path
    sampling_rate: float
    labels: tuple[str, ...]
    emission: NDArray[np.float64]
    read: Callable[[int], NDArray[Any]]
    columns: Columns
    settings: dict[str, dict[str, Any]] = field(default_factory=dict)
    notes: tuple[str, ...] = ()

    def __len__(self) -> int:
        return len(self.labels)
