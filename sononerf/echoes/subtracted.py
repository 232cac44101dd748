# SPDX-License-Identifier: MIT
"""Echoes of a target in surroundings, minus those of the surroundings alone."""

from __future__ import annotations

from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np

from sononerf.array_types import Singles
from sononerf.echoes.layout import AXES
from sononerf.echoes.store import EnsembleStore
from sononerf.errors import IncompatibleError, InputError, NumericalError


class SubtractedStore(EnsembleStore):
    """Ensemble from which the power of another one at the same poses is subtracted.

    There is no phase, so power is subtracted cell by cell. A cell in which the surroundings alone
    have more power becomes silent.
    """

    def __init__(self, path: Path, background: Path) -> None:
        super().__init__(path)
        self._background = EnsembleStore.open(background)
        for name in AXES:
            mine, theirs = self._axes[name], self._background._axes[name]
            if mine.shape != theirs.shape or not np.allclose(mine, theirs, rtol=0, atol=1e-6):
                raise IncompatibleError(
                    f"{background}: its {name} differs from that of {path}; a background is heard "
                    "at the same poses and analysed alike"
                )
        missing = self._background.missing()
        if missing:
            raise InputError(
                f"{background}: pose {missing[0]} is missing; finish it with `sononerf simulate`"
            )

    def __reduce__(self) -> tuple[Any, ...]:
        return SubtractedStore, (self.path, self._background.path)

    def read_pose(self, index: int) -> Singles:
        """Return one pose's magnitude, (E, R, F), without the surroundings."""
        whole = np.square(super().read_pose(index), dtype=np.float64)
        left = whole - np.square(self._background.read_pose(index), dtype=np.float64)
        return np.sqrt(left.clip(min=0.0)).astype(np.float32)

    @property
    def attributes(self) -> dict[str, Any]:
        """Attributes of the whole, except for the loudness of the rest, without a noise floor."""
        unknown = dict.fromkeys(("noise_floor_mae_db", "noise_floor_mae_db_active", "noise"))
        given = super().attributes
        return {**given, **unknown, "reference": given["reference"] * self._part}

    @cached_property
    def _part(self) -> float:
        """Level of the loudest training cell over that of the whole."""
        train = [int(index) for index in self.indices("train")]
        left = max(float(self.read_pose(index).max()) for index in train)
        if not left > 0.0:
            raise NumericalError(
                f"{self._background.path}: as loud as {self.path} everywhere, so nothing is left; "
                "is it the same ensemble?"
            )
        return left / max(float(super(SubtractedStore, self).read_pose(i).max()) for i in train)
