# SPDX-License-Identifier: MIT
"""Reported decibels: compressed levels, active cells, and the error between spectrograms."""

from __future__ import annotations

import math
from collections.abc import Iterator
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from sononerf.errors import NumericalError
from sononerf.numerics import Floats

RANGE_DB = 60.0
"""Level of the loudest cell above the reference, dB; also the scale of PSNR and SSIM."""
ACTIVE_DB = 3.0
"""Level from which a cell is active, dB."""
FALSE_ACTIVE_RATE = 1e-3
"""Probability that a cell of noise counts as active, no unit: one cell in a thousand does not move
a mean over active cells."""
CHUNK_POSES = 8
"""Number of poses that are compared at once; more of them would only take more memory."""


def compress(magnitude: ArrayLike, reference: float) -> Floats:
    """Decibels above a soft floor, ``20 log10(1 + magnitude / reference)``.

    In: magnitude (...,). Out: level_db ((...,), dB).
    """
    if not reference > 0.0:
        raise ValueError(f"reference is {reference}, expected above 0")
    return (20.0 / math.log(10.0)) * np.log1p(np.asarray(magnitude, dtype=np.float64) / reference)


def active_level(noise: ArrayLike | None, reference: float) -> float | Floats:
    """Return the level from which a cell is active, dB: one number, or (E, 1, F) above noise.

    In: noise ((E, F) or None).
    """
    if noise is None:
        return ACTIVE_DB
    exceeded = np.asarray(noise, dtype=np.float64) * math.sqrt(math.log(1.0 / FALSE_ACTIVE_RATE))
    return np.maximum(compress(exceeded, reference), ACTIVE_DB)[:, None]


def expand(level_db: ArrayLike, reference: float) -> Floats:
    """Return the linear magnitude of compressed levels: the inverse of :func:`compress`."""
    return reference * (10.0 ** (np.asarray(level_db) / 20.0) - 1.0)


def same_shape(measured: ArrayLike, predicted: ArrayLike) -> tuple[Any, Any]:
    """Return both as arrays; raises ValueError if their shapes differ or they are empty."""
    a, b = np.asanyarray(measured), np.asanyarray(predicted)
    if a.shape != b.shape:
        raise ValueError(f"measured {a.shape} and predicted {b.shape} differ in shape")
    if not a.size:
        raise ValueError(f"measured has shape {a.shape}: nothing to compare")
    return a, b


def pose_chunks(
    measured: NDArray[np.floating], predicted: NDArray[np.floating]
) -> Iterator[tuple[Floats, Floats]]:
    """Yield a few poses of both at a time; raises NumericalError at a value that is not finite."""
    for start in range(0, len(measured), CHUNK_POSES):
        a, b = (
            np.asarray(spectrograms[start : start + CHUNK_POSES], dtype=np.float64)
            for spectrograms in (measured, predicted)
        )
        for name, values in (("measured", a), ("predicted", b)):
            if not np.isfinite(values).all():
                pose = start + int(np.argwhere(~np.isfinite(values))[0][0])
                raise NumericalError(f"the {name} spectrogram {pose} holds values not finite")
        yield a, b


def mae_all_and_active(
    measured: NDArray[np.floating], predicted: NDArray[np.floating], active_db: float | Floats
) -> tuple[float, float | None]:
    """Mean absolute error over all cells, and over active ones; None where none is active."""
    total = active_total = 0.0
    active_count = 0
    for a, b in pose_chunks(measured, predicted):
        error = np.abs(a - b)
        active = (a >= active_db) | (b >= active_db)
        total += float(error.sum())
        active_total += float(error[active].sum())
        active_count += int(active.sum())
    return total / measured.size, active_total / active_count if active_count else None


def mae_db(
    a: ArrayLike, b: ArrayLike, *, active: bool = False, active_db: float | Floats = ACTIVE_DB
) -> float | None:
    """Mean absolute difference of two sets of spectrograms.

    In: a, b ((P, ...), dB), active_db (dB). Out: error (dB).
    """
    first, second = same_shape(a, b)
    return mae_all_and_active(first, second, active_db)[1 if active else 0]
