# SPDX-License-Identifier: MIT
"""Levels of the echoes over range: power of bands of frequencies, averaged over few slices."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass, replace

import numpy as np
from scipy.ndimage import maximum_filter1d

from sononerf.geometry.plane import Plane
from sononerf.numerics import Floats, Ints, Singles

BANDS = 3
"""Number of bands of equally many frequencies; the mean power is that of their levels."""
PER_RESOLUTION = 4
"""Number of levels per range resolution, about; as in the training of the start network."""
MOST_PAIRS, FEWEST_POSES = 1280, 40
"""Number of pose-ear pairs that are used, at most, but of this many poses at least; it bounds time
and memory."""
WINDOW = 1.5
"""Distance within which a level is compared with the loudest one, range resolutions."""
_QUIETEST = -60.0  # dB below the loudest level of all; quieter levels count as this one
_OFF = 12.0  # dB below the loudest level around that are counted, at most


@dataclass(frozen=True, eq=False)
class RangeLevels:
    """Levels of the echoes of poses over range."""

    poses: Ints  # (P,): Numbers of the poses among those that have onsets
    emitters: Floats  # (P, 3), m: World frame
    receivers: Floats  # (P, E, 3), m: World frame
    # (P, E, R, 3), dB: Levels of the lowest band, of the highest band, and of all frequencies; 0 dB
    # is the loudest level of all
    level: Singles
    first: float  # m: Range of the first level: half of the way out and back
    spacing: float  # m: Distance between levels
    resolution: float  # m: Range resolution

    @classmethod
    def of(
        cls,
        spectrograms: Iterable[Singles],
        poses: Ints,
        emitters: Floats,
        receivers: Floats,
        *,
        first: float,
        spacing: float,
        resolution: float,
    ) -> RangeLevels:
        """Return the levels of spectrograms.

        In: spectrograms (P of (E, R, F)), first, spacing (m).
        """
        step = max(1, round(resolution / spacing / PER_RESOLUTION))
        power = np.array([_banded(one, step) for one in spectrograms])
        power /= float(power.mean(axis=-1).max(initial=0.0)) or 1.0
        power = np.maximum(power, 10 ** (_QUIETEST / 10))
        kept = np.stack([power[..., 0], power[..., -1], power.mean(axis=-1)], axis=-1)
        return cls(
            poses,
            emitters,
            receivers,
            (10 * np.log10(kept)).astype(np.float32),
            first + (step - 1) / 2 * spacing,
            step * spacing,
            resolution,
        )

    def with_images(self, plane: Plane, count: int) -> RangeLevels:
        """Return the levels at the poses, and the same at their images in a support."""
        return replace(
            self,
            poses=np.concatenate([self.poses, count + self.poses]),
            emitters=np.concatenate([self.emitters, plane.mirrored(self.emitters)]),
            receivers=np.concatenate([self.receivers, plane.mirrored(self.receivers)]),
            level=np.concatenate([self.level, self.level]),
        )

    def table(self, middle: Floats) -> Singles:
        """Return the levels relative to the usual loudest one, and peaks, (P, E, R, 4) dB.

        The first three are the attribute ``level``, less the median over poses and ears of the
        loudest one, as if it came from the middle (3,), m. The last is how far a level is below the
        loudest one within ``WINDOW``.
        """
        ways = np.linalg.norm(self.emitters - middle, axis=1)[:, None] * np.linalg.norm(
            self.receivers - middle, axis=2
        )
        whole = self.level[..., 2]
        usual = np.median(whole.max(axis=2) + 20 * np.log10(ways))
        size = 2 * round(WINDOW * self.resolution / self.spacing) + 1
        below = (whole - maximum_filter1d(whole, size, axis=2)).clip(-_OFF, 0)
        return np.concatenate([self.level - np.float32(usual), below[..., None]], axis=3)


def evenly_chosen(count: int, ears: int) -> Ints:
    """Return the numbers of the poses, of so many, that are used, in order."""
    most = max(MOST_PAIRS // ears, FEWEST_POSES)
    if count <= most:
        return np.arange(count)
    return np.sort(np.random.default_rng(0).choice(count, most, replace=False))


def _banded(spectrogram: Singles, step: int) -> Floats:
    """Return the power (E, R // step, BANDS) of a spectrogram (E, R, F), averaged over slices."""
    power = np.square(spectrogram, dtype=np.float64)
    bands = [part.mean(axis=2) for part in np.array_split(power, BANDS, axis=2)]
    found = np.stack(bands, axis=-1)
    count = found.shape[1] // step
    return found[:, : count * step].reshape(len(found), count, step, BANDS).mean(axis=2)
