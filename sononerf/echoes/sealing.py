# SPDX-License-Identifier: MIT
"""What every ensemble gets at its end, simulated or recorded: reported decibels, noise floor."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from sononerf.echoes.store import EnsembleStore
from sononerf.errors import NumericalError
from sononerf.head.decibels import RANGE_DB, compress, mae_db


def seal(store: EnsembleStore, again: dict[int, NDArray[np.float32]], *, silent: str) -> None:
    """Fix the reported decibels and the noise floor of a complete ensemble, and seal it.

    Args:
        store: No pose is missing.
        again: By number of a test pose, what the same pose heard another time, (E, R, F).
        silent: What to say if no training pose heard anything.

    Raises:
        NumericalError: If no training pose heard anything.
    """
    loudest = max(float(store.read_pose(int(i)).max()) for i in store.indices("train"))
    if loudest <= 0.0:
        raise NumericalError(silent)
    reference = loudest * 10.0 ** (-RANGE_DB / 20.0)
    noise: dict[str, float | None] = {"noise_floor_mae_db": None, "noise_floor_mae_db_active": None}
    if again:
        first = compress(np.stack([store.read_pose(i) for i in again]), reference)
        second = compress(np.stack(list(again.values())), reference)
        noise["noise_floor_mae_db"] = mae_db(first, second)
        noise["noise_floor_mae_db_active"] = mae_db(first, second, active=True)
    store.update_attributes(reference=reference, **noise)
    store.seal()
