# SPDX-License-Identifier: MIT
"""A measured directivity: gains of receivers, and perhaps of the emitter, over direction."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.sparse import csr_array

from sononerf.errors import InputError
from sononerf.head.directivity.sphere import interpolation

MOST_RECEIVERS = 256

Array = NDArray[np.float64]


@dataclass(frozen=True, eq=False)
class Directivity:
    """Linear gains in the head frame (x forward, y left, z up).

    Attributes:
        source: Where it was read from, for messages.
        directions (M, 3): Unit vectors from the head to where sound comes from or goes to, in any
            order.
        frequency ((F,), Hz): Ascending.
        gains (E, M, F): Of each receiver, zero or more.
        beam ((M, F) or None): Of the emitter; None where the file has none.
        places ((E, 3) or None, m): Of the receivers; None where the file does not state them.

    Raises:
        InputError: If shapes do not fit, or a value is not allowed.
    """

    source: str
    directions: Array
    frequency: Array
    gains: Array
    beam: Array | None = None
    places: Array | None = None

    def __post_init__(self) -> None:
        self._check_shapes()
        named: dict[str, Array] = {
            "frequencies": self.frequency,
            "directions": self.directions,
            "gains": self.gains,
        }
        if self.beam is not None:
            named["emitter's gains"] = self.beam
        if self.places is not None:
            named["places"] = self.places
        for name, values in named.items():
            if not np.isfinite(values).all():
                raise InputError(f"{self.source}: the {name} hold NaN or infinite values")
        if (np.diff(self.frequency) <= 0.0).any() or self.frequency[0] < 0.0:
            raise InputError(f"{self.source}: the frequencies do not ascend from 0 Hz or above")
        length = np.linalg.norm(self.directions, axis=1)
        if not np.allclose(length, 1.0, atol=1e-6):
            raise InputError(f"{self.source}: a direction is no unit vector")
        for name in ("gains", "emitter's gains"):
            least, most = (named[name].min(), named[name].max()) if name in named else (0.0, 1.0)
            if least < 0.0:
                raise InputError(
                    f"{self.source}: the {name} hold the negative value {least:.3g}; "
                    "expected linear gains of 0 or more"
                )
            if most == 0.0:
                raise InputError(f"{self.source}: the {name} are all zero")

    def _check_shapes(self) -> None:
        receivers = len(self.gains) if self.gains.ndim == 3 else 0
        expected = (len(self.directions), len(self.frequency))
        if not expected[0] or not expected[1]:
            raise InputError(f"{self.source}: holds no directions or no frequencies")
        if not 1 <= receivers <= MOST_RECEIVERS:
            raise InputError(
                f"{self.source}: holds {receivers} receivers, expected 1 to {MOST_RECEIVERS}"
            )
        found = {"gains": self.gains.shape[1:]}
        if self.beam is not None:
            found["emitter's gains"] = self.beam.shape
        for name, shape in found.items():
            if shape != expected:
                raise InputError(
                    f"{self.source}: the {name} have the shape {shape}, expected {expected} "
                    "(directions, frequencies)"
                )
        if self.places is not None and self.places.shape != (receivers, 3):
            raise InputError(
                f"{self.source}: states {len(self.places)} places of {receivers} receivers"
            )

    def weights(self, directions: Array) -> csr_array:
        """Return the weights (N, M) that bring gains to directions (N, 3); rows sum to 1 or less.

        Linear between measured directions; outside the measured area the nearest measured gain
        fades to zero over 10 degrees.
        """
        return interpolation(self.directions, directions)

    def at(self, frequency: Array, values: Array) -> Array:
        """Return gains (..., M, F) at other frequencies (K,), (..., M, K).

        Linear between measured frequencies; outside of them the nearest measured one counts.
        """
        known = self.frequency
        right = np.searchsorted(known, frequency).clip(1, max(len(known) - 1, 1))
        if len(known) == 1:
            return np.repeat(values, len(frequency), axis=-1)
        left = right - 1
        part = ((frequency - known[left]) / (known[right] - known[left])).clip(0.0, 1.0)
        found: Array = values[..., left] * (1.0 - part) + values[..., right] * part
        return found


def unit_vectors(azimuth: Array, elevation: Array) -> Array:
    """Return unit vectors (..., 3) of azimuths (to the left) and elevations (up), rad.

    The two are broadcast against each other.
    """
    level = np.cos(elevation)
    parts = (level * np.cos(azimuth), level * np.sin(azimuth), np.sin(elevation))
    return np.stack(np.broadcast_arrays(*parts), axis=-1)
