# SPDX-License-Identifier: MIT
"""Levels of the echoes over range, and their statistics over all poses at a place.

An edge or a corner is heard from nearly everywhere, so that most poses have a level at its range. A
face is heard by few poses, but loudly and from its normal. Inside a body only chance gives levels.
This needs no fit; the fitted field explains many of these echoes by other places.
"""

from __future__ import annotations

import math
from collections.abc import Iterable
from dataclasses import dataclass

import numpy as np
from scipy.ndimage import maximum_filter1d

from sononerf.array_types import Floats, Singles
from sononerf.compiled import compiled

STATISTICS = 10
"""Number of statistics of a place; the last three are a vector."""
MOST = 200
"""Number of poses that are used, at most; it bounds the time."""
WINDOW = 1.5
"""Distance within which a level is compared with the loudest one, range resolutions."""
_QUIETEST, _BINS, _PER_DB = -44.0, 64, 1.25  # dB, number, 1/dB: bins of the levels of a place
_LOUD = -40.0  # dB; quieter levels count as this one
_PEAK, _OFF = 1.0, 12.0  # dB below the loudest level around: a peak, and the most that is counted
_SILENT = 1e-6  # of the greatest power of all; quieter counts as this


@dataclass(frozen=True, eq=False)
class RangeLevels:
    """Levels of the echoes of all poses over range, averaged over frequency.

    Attributes:
        emitters ((P, 3), m): World frame.
        receivers ((P, E, 3), m): World frame.
        level ((P, E, R), dB): 0 dB is an arbitrary level.
        below ((P, E, R), dB): Level minus the loudest one within ``WINDOW``, from -12 to 0.
        first (m): Range of the first level: half of the way out and back.
        spacing (m): Distance between levels.
    """

    emitters: Floats
    receivers: Floats
    level: Singles
    below: Singles
    first: float
    spacing: float

    @classmethod
    def of(
        cls,
        spectrograms: Iterable[Singles],
        emitters: Floats,
        receivers: Floats,
        *,
        first: float,
        spacing: float,
        resolution: float,
    ) -> RangeLevels:
        """Return the levels of spectrograms.

        Args:
            spectrograms (P of (E, R, F)): Linear magnitudes.
            emitters, receivers, first, spacing: As the attributes.
            resolution (m): Range resolution.
        """
        power = np.array([np.square(one, dtype=np.float64).mean(axis=2) for one in spectrograms])
        power /= float(power.max(initial=0.0)) or 1.0
        level = 10 * np.log10(np.maximum(power, _SILENT))
        size = 2 * round(WINDOW * resolution / spacing) + 1
        below = (level - maximum_filter1d(level, size, axis=2)).clip(-_OFF, 0)
        below[power <= _SILENT] = -_OFF
        return cls(
            emitters,
            receivers,
            level.astype(np.float32),
            below.astype(np.float32),
            first,
            spacing,
        )

    def statistics(self, places: Floats, middle: Floats) -> Singles:
        """Return the statistics of places over all poses and ears, (N, STATISTICS), no unit.

        They are the mean level, its mean below the loudest around, the fraction of peaks, three
        quantiles and the maximum, and the mean direction of the sound.

        Args:
            places ((N, 3), m): World frame.
            middle ((3,), m): Middle of the body; levels are relative to the median over poses of
                the loudest one, as if it came from here.
        """
        emitters, receivers, level, below = self.emitters, self.receivers, self.level, self.below
        ways = (
            np.linalg.norm(emitters - middle, axis=1)[:, None],
            np.linalg.norm(receivers - middle, axis=2),
        )
        usual = float(np.median(level.max(axis=2) + 20 * np.log10(ways[0] * ways[1])))
        count = len(emitters)
        some = np.unique(np.linspace(0, count - 1, min(count, MOST)).astype(np.int64))
        return _statistics(
            np.ascontiguousarray(places, dtype=np.float64),
            emitters[some],
            receivers[some],
            level[some] - np.float32(usual),
            below[some],
            self.first,
            self.spacing,
        )


@compiled
def _statistics(
    places: Floats,
    emitters: Floats,
    receivers: Floats,
    level: Singles,
    below: Singles,
    first: float,
    spacing: float,
) -> Singles:
    found = np.zeros((len(places), STATISTICS), np.float32)
    for n in range(len(places)):
        bins = np.zeros(_BINS, np.int64)
        count, peaks = 0, 0
        levels, off, total, highest = 0.0, 0.0, 0.0, -1e9
        direction = np.zeros(3)
        for p in range(emitters.shape[0]):
            way = emitters[p] - places[n]
            out = math.sqrt(way[0] * way[0] + way[1] * way[1] + way[2] * way[2])
            for ear in range(receivers.shape[1]):
                x, y, z = (
                    receivers[p, ear, 0] - places[n, 0],
                    receivers[p, ear, 1] - places[n, 1],
                    receivers[p, ear, 2] - places[n, 2],
                )
                back = math.sqrt(x * x + y * y + z * z)
                at = ((out + back) / 2 - first) / spacing
                row = math.floor(at)
                if row < 0 or row >= level.shape[2] - 1:
                    continue
                part = at - row
                heard = level[p, ear, row] * (1 - part) + level[p, ear, row + 1] * part
                lower = below[p, ear, row] * (1 - part) + below[p, ear, row + 1] * part
                heard += 20 * math.log10(out * back)  # without spreading
                bins[min(max(int((heard - _QUIETEST) * _PER_DB), 0), _BINS - 1)] += 1
                count += 1
                levels += max(heard, _LOUD)
                off += lower
                peaks += lower > -_PEAK
                highest = max(highest, heard)
                amplitude = 10 ** (heard / 20)
                total += amplitude
                for k in range(3):
                    direction[k] += amplitude * way[k] / out
        if count == 0:
            continue
        found[n, 0] = levels / count / 20 + 1
        found[n, 1] = off / count / 6 + 1
        found[n, 2] = peaks / count
        below_it, bin_ = 0, -1
        for k, part in enumerate((0.1, 0.5, 0.9)):
            while below_it < part * count:
                bin_ += 1
                below_it += bins[bin_]
            found[n, 3 + k] = ((bin_ + 0.5) / _PER_DB + _QUIETEST) / 20 + 1
        found[n, 6] = highest / 20 + 0.5
        for k in range(3):
            found[n, 7 + k] = 2 * direction[k] / total
    return found
