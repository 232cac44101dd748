# SPDX-License-Identifier: MIT
"""Onsets: the first echo of each pose and ear, and the levels over range that a network reads.

In: spectrograms (E, R, F) of an ensemble. Out: ranges of first echoes (P, E), m, infinite where
none was heard; levels (P, E, R', 3), dB. The threshold of a range follows from the noise before the
first echoes, so that false alarms have a constant rate [1]_. Section 1 of ``docs/method.md``.

References:
    .. [1] H. Rohling, "Radar CFAR thresholding in clutter and multiple target situations", 1983.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable
from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import maximum_filter1d
from scipy.special import gammainc, gammaincinv

from sononerf.echoes.memory_ensemble import Ensemble, repeats, seal
from sononerf.geometry.meshes import Plane
from sononerf.geometry.poses import Poses
from sononerf.head.front_end import FALSE_ACTIVE_RATE
from sononerf.head.head import Head, PointEcho, own_top
from sononerf.head.row_filters import band_mean
from sononerf.numerics import Bools, Floats, Ints, Singles

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
        path_product = np.linalg.norm(self.emitters - middle, axis=1)[:, None] * np.linalg.norm(
            self.receivers - middle, axis=2
        )
        whole = self.level[..., 2]
        usual = np.median(whole.max(axis=2) + 20 * np.log10(path_product))
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


FALSE_ALARMS = 1e-6
"""Probability that a range slice of noise alone is taken for an echo, no unit. An ensemble of 400
poses has some ten thousand independent slices per ear, and one false onset hides a place."""
RANK = 0.1
"""Quantile that is the level of noise and precursors, no unit. Echoes may fill nine tenths of the
range axis, and nine tenths of the poses may have other echoes in front of their loudest."""
ONSET = 0.1
"""Fraction of an echo's power at which its range is read, no unit. This early in the rise, a second
echo within the window has not begun."""

DYNAMIC_RANGE = 1e-8
"""Least threshold over the loudest power of all poses, no unit: 80 dB, what 14 bits record. Without
noise even the rounding of a simulator would be detected."""


def threshold_factor(looks: float) -> float:
    """Return the threshold over the quantile of noise power.

    Examples:
        >>> round(threshold_factor(1.0))  # ln(1e-6) / ln(0.9)
        131
    """
    low, high = gammaincinv(looks, [RANK, 1.0 - FALSE_ALARMS])
    return float(high / low)


class Levels(NamedTuple):
    """Levels that an echo must exceed."""

    noise: Floats  # (..., 1) threshold of noise alone
    total: Floats  # (..., R) threshold of noise, precursors, and echoes that the first slice cuts


def threshold_levels(power: Floats, looks: float, ahead: Floats | None = None) -> Levels:
    """Return the thresholds of noise, and of noise and precursors.

    In: power (..., R), ahead (L,), the least precursors: those of the call.
    """
    factor = threshold_factor(looks)
    noise = factor * np.quantile(power, RANK, axis=-1, keepdims=True)
    noise = np.maximum(noise, DYNAMIC_RANGE * power.max(initial=0.0))
    total = np.broadcast_to(noise, power.shape).copy()
    precursors = _precursors(power.reshape(-1, power.shape[-1]))
    if ahead is not None and len(ahead):
        size = max(len(precursors), min(len(ahead), power.shape[-1] - 1))
        both = [np.pad(each[:size], (0, max(size - len(each), 0))) for each in (precursors, ahead)]
        precursors = np.maximum(*both)
    precursors = factor * precursors
    own = precursors >= 1.0
    guard = int(own.argmin()) if not own.all() else len(own)
    behind = precursors[guard:]
    if len(behind):
        # A fainter top raises no level above that of noise.
        telling = _is_top(power) & (power * behind.max() > noise)
        for *row, slice_ in np.argwhere(telling).tolist():
            last = slice_ - guard
            if last > 0:
                part = total[tuple(row)][max(last - len(behind), 0) : last]
                level = power[(*row, slice_)] * behind[: len(part)][::-1]
                np.maximum(part, level, out=part)
    ahead = power[..., :1]
    return Levels(noise, np.where(ahead > total[..., :1], np.maximum(total, factor * ahead), total))


def _is_top(power: Floats) -> Bools:
    """Return the mask (..., R) of slices that are louder than their neighbours; the last may be."""
    top = np.zeros(power.shape, dtype=bool)
    top[..., 1:-1] = (power[..., 1:-1] >= power[..., :-2]) & (power[..., 1:-1] > power[..., 2:])
    top[..., -1] = power[..., -1] > power[..., -2]
    return top


def _precursors(power: Floats) -> Floats:
    """Return the level in front of the loudest slice over its own, from one slice on, (L,)."""
    top = power.argmax(axis=1)
    sounding = power[np.arange(len(top)), top] > 0.0
    power, top = power[sounding], top[sounding]
    ratios = []
    for lag in range(1, power.shape[1]):
        late_enough = np.flatnonzero(top >= lag)
        if len(late_enough) * RANK < 1.0:  # too few to be ranked
            break
        at = top[late_enough]
        ratios.append(np.quantile(power[late_enough, at - lag] / power[late_enough, at], RANK))
    return np.asarray(ratios)


def onsets(
    power: Floats,
    levels: Levels,
    window: Floats | Callable[[int, int], Floats],
    fineness: float,
    start: Floats | None = None,
) -> Floats:
    """Return where the first echo of each row is, in slices from the first one, (N,).

    The range is read where the power has risen to a tenth of the echo's, or to the threshold of
    noise where that is more, and moved by the distance from there to the middle of a point echo.

    In: power (N, R), window ((W,) or callable: row and slice give it), start (N,), the first slices
    that may hold an echo. Out: onset (N,), minus infinity where nothing was heard or the first
    slice cuts an echo.
    """
    onset = np.full(len(power), -np.inf)
    start = np.zeros(len(power)) if start is None else start
    late = np.arange(power.shape[1]) >= start[:, None]
    inner = (_is_top(power) & (power > levels.total) & late)[:, 1:-1]
    for row in np.flatnonzero(inner.any(axis=1)):
        top = int(inner[row].argmax()) + 1
        echo = power[row, : top + 1] / power[row, top]
        fraction = max(ONSET, float(levels.noise[row, 0]) / power[row, top])
        before = np.flatnonzero((echo[:top] < fraction) & late[row, :top])
        if len(before):  # else it began before the first slice
            rising, middle = _flank(window(int(row), top) if callable(window) else window)
            rise = middle - _crossing(rising, fraction)
            onset[row] = _crossing(echo[int(before[-1]) :], fraction) + before[-1] + rise * fineness
    return onset


def _flank(window: Floats) -> tuple[Floats, float]:
    """Return the rise of a point echo to its first maximum, from zero to one, and its own range."""
    if np.allclose(window, window[::-1]):
        tops = np.flatnonzero(window == window.max())
        first, middle = int(tops[0]), float(tops.mean())
    else:
        first, middle = own_top(window), (len(window) - 1) / 2.0
    rising = window[: first + 1] / window[first]
    return np.concatenate(([0.0], rising)), middle + 1.0


def _crossing(rising: Floats, fraction: float) -> float:
    """Return where decibels last rise through a fraction of one, between values."""
    before = int(np.flatnonzero(rising < fraction)[-1])
    low, high = np.log10(np.maximum(rising[before : before + 2], 1e-30))
    return before + float((np.log10(fraction) - low) / (high - low))


MOST_POSES = 1000
"""Number of training poses, at most, whose onsets are detected, evenly over all; it bounds the
memory. Further poses add less to the free space than the accuracy of an onset."""


@dataclass(frozen=True, eq=False)
class Onsets:
    """First echoes of the poses."""

    poses: Ints  # (P,): Their numbers in the store, ascending
    range: Floats  # (R,), m: Range of the slices
    power: Floats  # (P, E, R): Power, averaged over the band
    heard: Bools  # (P, E, R): True for slices with an echo
    # (P, E), m: Range of the first echo; minus infinity without an echo, or if it is cut
    first: Floats
    # (P, E, R) or None: True for slices in which the sweep's precursors lie below the noise; None
    # of an impulse
    undisturbed: Bools | None = None

    def chance(self, resolution: float) -> float:
        """Return the probability that noise alone makes at least this number of onsets.

        In: resolution (m).
        """
        extent = len(self.range) * float(self.range[1] - self.range[0])
        tries = self.first.size * extent / resolution
        # The upper tail of a Poisson distribution.
        return float(gammainc(np.isfinite(self.first).sum(), FALSE_ALARMS * tries))


def poses_in_use(store: Ensemble) -> Ints:
    """Return the numbers of the training poses that are analysed, ascending."""
    train = np.asarray(store.indices("train"))
    chosen = np.linspace(0, len(train) - 1, min(MOST_POSES, len(train))).round().astype(int)
    return np.asarray(train[chosen])


def find_onsets(store: Ensemble, echo: PointEcho, *, nearest: Floats | None = None) -> Onsets:
    """Detect the echoes of a sealed ensemble's analysed poses. In: nearest ((P, E), m)."""
    poses = poses_in_use(store)
    axis = np.asarray(store.range, dtype=np.float64)
    heard = (np.square(store.read_pose(int(i)), dtype=np.float64) for i in poses)
    if echo.rows is None:
        power = np.stack([each.mean(axis=-1) for each in heard])
    else:
        power = np.stack([band_mean(each, store.frequency) for each in heard])
    step = float(axis[1] - axis[0])
    levels = threshold_levels(power, echo.looks, echo.ahead(step))
    fineness = echo.spacing / step
    start = np.zeros(power.shape[:2])
    if nearest is not None:
        start = np.ceil((nearest - axis[0]) / step).clip(0, len(axis) - 1)
    begun = np.arange(len(axis)) >= start[..., None]
    onsets_of_ears = []
    for ear in range(power.shape[1]):

        def own_window(row: int, top: int, ear: int = ear) -> Floats:
            return echo.of_spectrum(store.read_pose(int(poses[row]))[ear, top])

        window = echo.window if echo.rows is None else own_window
        level = Levels(*(each[:, ear] for each in levels))
        onsets_of_ears.append(onsets(power[:, ear], level, window, fineness, start[:, ear]))
    first = axis[0] + step * np.stack(onsets_of_ears, axis=1)
    undisturbed = None if echo.precursors is None else levels.total <= levels.noise
    return Onsets(poses, axis, power, (power > levels.total) & begun, first, undisturbed)


NOISE_GAP = 2.0
"""Least distance, range resolutions, between the first echo and the slices in front of it that give
the noise: the echo's rising flank and nearest sidelobes lie closer."""
MIN_NOISE_SLICES = 100
"""Least number of slices, over all poses, that give the noise of a receiver."""


def noise_rms(store: Ensemble, head: Head) -> Floats | None:
    r"""Return the root mean square of the noise, (E, F) linear magnitude.

    Noise of many sources has a magnitude of Rayleigh's distribution: the median of its power is
    :math:`\sigma^2 \ln 2`, and its magnitude exceeds :math:`\sigma \sqrt{\ln(1 / p)}` with
    probability p.
    """
    onsets = find_onsets(store, head.point_echo)
    quiet = (
        store.range[None, None] < onsets.first[..., None] - NOISE_GAP * head.resolution
    )  # (P, E, R)
    if onsets.undisturbed is not None:
        quiet &= onsets.undisturbed
    if (quiet.sum(axis=(0, 2)) < MIN_NOISE_SLICES).any():
        return None
    heard: list[list[Singles]] = [[] for _ in range(store.receivers)]
    for row, pose in enumerate(onsets.poses.tolist()):
        magnitude = store.read_pose(pose)
        for ear, kept in enumerate(heard):
            kept.append(magnitude[ear][quiet[row, ear]])
    power = np.stack([np.median(np.square(np.concatenate(kept)), axis=0) for kept in heard])
    return np.asarray(np.sqrt(power.astype(np.float64) / math.log(2.0)))


def heard_again(magnitude: NDArray[np.floating], noise: Floats, seed: int) -> Singles:
    """Return another draw of the same pose's spectrogram, (E, R, F).

    Cells above the noise get the difference of two draws of noise. Cells below are noise, and are
    drawn again.

    In: magnitude (E, R, F), noise (E, F).
    """
    rng = np.random.default_rng(seed)
    parts = rng.standard_normal((2, *magnitude.shape)) * (noise[:, None] / math.sqrt(2.0))
    drawn = parts[0] + 1j * parts[1]
    least = noise[:, None] * math.sqrt(math.log(1.0 / FALSE_ACTIVE_RATE))
    again = np.where(magnitude > least, np.abs(magnitude + math.sqrt(2.0) * drawn), np.abs(drawn))
    return again.astype(np.float32)


def seal_recorded(
    store: Ensemble, head: Head, poses: Poses, split: NDArray[np.int8], *, silent: str
) -> None:
    """Seal recorded echoes with their noise, and the noise floor of the test poses.

    The floor comes from poses that were recorded twice, or else from the noise before the first
    echoes.

    In: split (P,).
    """
    pairs = repeats(poses, split)
    again = {index: store.read_pose(other) for index, other in pairs.items()}
    test: Ints = store.indices("test")
    source, noise = ("repeated poses" if again else None), None
    if any(store.read_pose(int(index)).any() for index in store.indices("train")):
        noise = noise_rms(store, head)
    if noise is not None and noise.any() and not again and len(test):
        source = "noise before the first echoes"
        for index in test.tolist():
            again[index] = heard_again(store.read_pose(index), noise, index)
    store.update_attributes(noise_floor_of=source)
    seal(store, again, silent=silent, noise=noise)
