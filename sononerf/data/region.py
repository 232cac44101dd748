# SPDX-License-Identifier: MIT
"""Where something can be, judged from sound and silence alone."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy import ndimage
from scipy.spatial.distance import cdist

from sononerf.acoustics.call import covered
from sononerf.acoustics.ears import Ears
from sononerf.acoustics.reception import effective_window
from sononerf.acoustics.spectrogram import frequency_axis
from sononerf.config import CallSettings, SpectrogramSettings
from sononerf.data.first_echo import asked_poses
from sononerf.data.noise_tops import noise_tops
from sononerf.data.store import EnsembleStore
from sononerf.errors import NumericalError
from sononerf.geometry.hull import EchoHull

Array = NDArray[np.float64]
Mask = NDArray[np.bool_]

HEARD_DB = 6.0
"""A range is heard where any cell of it reaches this, 60 dB below the loudest being zero."""
EVEN_DB = 3.0
"""And where it is no noise; of the loudest cells of both ears its quantiles lie no farther apart. A
pose that hears nothing but noise would have its echoes anywhere."""
WITNESS_GAIN = 0.1
"""A pose is a witness of the places towards which its gain is at least this part of the best."""
SILENT_SHARES = (0.02, 0.25)
"""A place is empty where more than this share of its witnesses heard their first echo behind it.

The strict share comes first. A flat face answers only from straight ahead, and poses that it does
not answer hear what stands behind: the lax share serves the sound that is still unexplained."""
HEARD_SHARE = 0.005
"""A place is empty where fewer than this share of its witnesses heard anything at its range."""
AGREEMENT = 0.6
"""A place is taken where the sound from its range is this part of the best place's, or more."""
UNEXPLAINED_SHARE = 0.02
"""The search for more places ends when only this share of the sound is not explained."""
ORIGIN_POSES = 3
"""So many poses must agree on a place for it to be where their first echoes came from."""
ROUNDS = 4
ECHO_END = 0.05
"""An echo ends where its magnitude is this part of its middle's; a Hamming window ends earlier."""
OUTSIDE = (0.3, 0.0005)
"""How far a place of a fit's lattice may lie outside of what first echoes leave: this part of how
far it speaks for its surroundings, and so many metres for the error of a first echo's range."""
LOOKS = 4
COARSE = 28
"""Cells along the longest side of each look."""
CHUNK = 2048


class Evidence(NamedTuple):
    """What the poses say about places."""

    possible: Mask  # (N,)
    energy: Array  # (N,) mean share of a pose's sound that comes from the place's range


def echo_power(call: CallSettings, analysis: SpectrogramSettings) -> Array:
    """Power of a point echo over time, (W,), one value per sample, over the rows it sounds in."""
    window = effective_window(call, analysis)
    swept = covered(call, frequency_axis(analysis))
    power: Array = ((window[swept] if swept.any() else window[:1]) ** 2).mean(axis=0)
    return power


def echo_reach(call: CallSettings, analysis: SpectrogramSettings, speed_of_sound: float) -> float:
    """How far in range one echo sounds to either side of its middle, over all frequencies, in m.

    Parameters
    ----------
    call : CallSettings
        What is emitted.
    analysis : SpectrogramSettings
        How echoes become spectrograms.
    speed_of_sound : float, m/s
        Of the medium.

    Examples
    --------
    >>> round(echo_reach(CallSettings(), SpectrogramSettings(), 343.0), 4)
    0.0054
    """
    sounding = np.flatnonzero(echo_power(call, analysis) >= ECHO_END**2)
    return float(sounding[-1] - sounding[0]) / 2.0 * speed_of_sound / 2.0 / analysis.sampling_rate


class EchoEvidence:
    """What the training poses say about places.

    Parameters
    ----------
    store : EnsembleStore
        A sealed ensemble; only its :func:`~sononerf.data.first_echo.asked_poses` are looked at.
    ears : Ears
        Gains and places of emitter and ears.
    reach : float, m
        How far in range one echo sounds to either side of its middle.
    hull : EchoHull or None
        What the first echoes leave, where it is known.
    most : int
        How many poses are asked at most, evenly spread over these.

    Raises
    ------
    NumericalError
        If no pose heard anything.
    """

    def __init__(
        self,
        store: EnsembleStore,
        ears: Ears,
        *,
        reach: float,
        hull: EchoHull | None = None,
        most: int = 400,
    ) -> None:
        self.reach = reach
        self.hull = hull
        indices = asked_poses(store)  # whose first echoes the hull is of
        chosen = np.linspace(0, len(indices) - 1, min(most, len(indices))).astype(int)
        indices = indices[chosen]
        self.range = np.asarray(store.range, dtype=np.float64)
        self.step = float(self.range[1] - self.range[0])
        threshold = float(store.attributes["reference"]) * (10 ** (HEARD_DB / 20) - 1)
        loudest, power = [], []
        for index in indices:
            spectrogram = store.read_pose(int(index))
            loudest.append(spectrogram.max(axis=(0, 2)))
            power.append((spectrogram**2).sum(axis=(0, 2)))
        tops = np.stack(loudest)  # (P, R)
        power_of_noise, noisy = noise_tops(tops.astype(np.float64) ** 2, EVEN_DB)
        noise = np.where(noisy, np.sqrt(power_of_noise), 0.0)
        self.heard = tops >= np.maximum(threshold, noise[:, None])
        # Under noise a faint echo is missed, so that silence tells less.
        self.shares = SILENT_SHARES[-1:] if np.median(noise) > threshold else SILENT_SHARES
        if not self.heard.any():
            raise NumericalError("no pose received an echo; check scene, poses and range limits")
        total = np.stack(power) * self.heard
        self.power = total / total.sum(axis=1, keepdims=True).clip(1e-30)
        silent = ~self.heard.any(axis=1)
        # Who hears nothing at all tells nothing about what lies in front.
        self.first = np.where(silent, -np.inf, self.range[self.heard.argmax(axis=1)])
        self.last = self.range[self.heard.shape[1] - 1 - self.heard[:, ::-1].argmax(axis=1)]
        # As the hull knows them, without those that tell nothing.
        self.nearest = np.full(len(indices), np.inf)
        if hull is not None:
            known = np.isfinite(hull.first[chosen])
            self.nearest = np.where(known, hull.first[chosen], np.inf).min(axis=1)
        self.rotations = np.asarray(store.rotations)[indices]
        # Emitter and ears lie about a centimetre apart: half way between them, the mean of the
        # ranges to both ears is met within a fraction of a millimetre.
        head = (ears.emitter + ears.positions.mean(axis=0)) / 2
        self.sources = np.asarray(store.positions)[indices] + self.rotations @ head
        gain = (ears.beam[None] * ears.ears).max(axis=(0, 1))  # (L, A)
        self.gain = gain / gain.max()

    def about(
        self,
        points: Array,
        tolerance: float,
        sound: Array | None = None,
        silent_share: float = SILENT_SHARES[-1],
    ) -> Evidence:
        """Return which places may hold something, and how much sound comes from their range.

        Parameters
        ----------
        points : (N, 3) float, m
            Places, world frame.
        tolerance : float, m
            How far a place speaks for its surroundings.
        sound : (P, R) float or None
            The sound that is looked at; all of it where None.
        silent_share : float
            What share of a place's witnesses may have heard their first echo behind it.
        """
        reach = int(np.ceil(tolerance / self.step))
        heard = ndimage.maximum_filter1d(self.heard, 2 * reach + 1, axis=1, mode="constant")
        power = ndimage.maximum_filter1d(
            self.power if sound is None else sound, 2 * reach + 1, axis=1, mode="constant"
        )
        parts = [
            self._about(points[start : start + CHUNK], tolerance, heard, power, silent_share)
            for start in range(0, len(points), CHUNK)
        ]
        return Evidence(
            np.concatenate([part.possible for part in parts]),
            np.concatenate([part.energy for part in parts]),
        )

    def _about(
        self, points: Array, tolerance: float, heard: Mask, power: Array, silent_share: float
    ) -> Evidence:
        distance, row, within = self._rows(points)
        witness = self._witnesses(points, distance)
        pose = np.arange(len(self.sources))[:, None]
        count = witness.sum(axis=0)
        silent = (witness & (distance + tolerance < self.first[:, None])).sum(axis=0)
        meets = witness & within
        sounding = (meets & heard[pose, row]).sum(axis=0)
        energy = (meets * power[pose, row]).sum(axis=0) / np.maximum(count, 1)
        possible = (
            (count > 0)
            & (silent <= silent_share * count)
            & (sounding >= np.maximum(2.0, HEARD_SHARE * count))
        )
        return Evidence(possible, energy)

    def _rows(self, points: Array) -> tuple[Array, NDArray[np.int64], Mask]:
        """Return each pose's distance to each place, and the range slice it falls in, (P, N)."""
        distance = cdist(self.sources, points).clip(1e-6)
        row = np.round((distance - self.range[0]) / self.step).astype(np.int64)
        within = (row >= 0) & (row < len(self.range))
        return distance, row.clip(0, len(self.range) - 1), within

    def _witnesses(self, points: Array, distance: Array) -> Mask:
        local = [
            np.einsum("pi,ni->pn", self.rotations[:, :, axis], points)
            - (self.rotations[:, :, axis] * self.sources).sum(1)[:, None]
            for axis in range(3)
        ]
        rows, columns = self.gain.shape
        azimuth = np.arctan2(local[1], local[0])
        elevation = np.arcsin((local[2] / distance).clip(-1, 1))
        row = np.round((elevation / np.pi + 0.5) * (rows - 1)).astype(np.int64)
        column = np.round((azimuth / (2 * np.pi) + 0.5) * (columns - 1)).astype(np.int64)
        return np.asarray(self.gain[row, column] >= WITNESS_GAIN)

    def box(self, margin: float = 0.01) -> Array:
        """Return the box around all that is needed to explain the echoes, (2, 3) m.

        Raises
        ------
        NumericalError
            If the poses leave no place possible.
        """
        # A flight along a line or on one side still hears so far ahead, and to the sides.
        looks = np.array([[3, 0, 0], [3, 2, 0], [3, -2, 0], [3, 0, 2], [3, 0, -2]])  # 34 degrees
        looks = looks / np.linalg.norm(looks, axis=1, keepdims=True)
        ahead = [self.sources + self.rotations @ look * self.last[:, None] for look in looks]
        ends = np.concatenate((self.sources, *ahead))
        lower, upper = ends.min(axis=0), ends.max(axis=0)
        for _ in range(LOOKS):  # coarse to fine
            spacing = float((upper - lower).max()) / COARSE
            axes = [
                np.arange(a + spacing / 2, b + spacing / 2, spacing)
                for a, b in zip(lower, upper, strict=True)
            ]
            points = np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1).reshape(-1, 3)
            kept = points[self.needed(points, spacing * np.sqrt(3) / 2)]
            if not len(kept):
                raise NumericalError(
                    "the echoes leave no place where something could be; set region.lower and "
                    "region.upper, or check the poses"
                )
            lower, upper = kept.min(axis=0) - spacing / 2, kept.max(axis=0) + spacing / 2
        return np.stack((lower - margin, upper + margin))

    def left(self, points: Array, tolerance: float) -> Mask:
        """Return the places that no pose rules out, (N,).

        Parameters
        ----------
        points : (N, 3) float, m
            Places, world frame.
        tolerance : float, m
            How far a place speaks for its surroundings.
        """
        # Silence of a mirror tells nothing, but of what is nearest the hull knows.
        lax = 1.0 if self.hull is not None else SILENT_SHARES[-1]
        possible = self.about(points, tolerance, silent_share=lax).possible
        return possible & self._in_hull(points, OUTSIDE[0] * tolerance + OUTSIDE[1])

    def _in_hull(self, points: Array, outside: float) -> Mask:
        if self.hull is None:
            return np.ones(len(points), dtype=bool)
        return np.asarray(self.hull.clearance(points)[0] >= -outside)

    def needed(self, points: Array, tolerance: float) -> Mask:
        """Return the places that explain the sound, the best focused first.

        Places out in the open lie at the range of *some* echo of many poses, but the echoes
        do not agree there. So the places where they agree best are taken, what they explain is
        taken out of the sound, and the rest is looked at anew, until little is left: a weak or
        hidden part is found in the sound that the loud ones cannot explain. Where first echoes are
        left without a place that they can come from, it is found last.
        """
        unexplained = self.power.copy()
        keep = np.zeros(len(points), dtype=bool)
        covered = np.zeros_like(self.heard)
        inside = self._in_hull(points, tolerance)
        for silent_share in self.shares:
            for _ in range(ROUNDS):
                evidence = self.about(points, tolerance, unexplained, silent_share)
                energy = np.where(evidence.possible & inside, evidence.energy, 0.0)
                before = int(keep.sum())
                if energy.max() > 0:
                    keep |= energy >= AGREEMENT * energy.max()
                if int(keep.sum()) == before:
                    break
                covered = self._covered(points[keep], tolerance)
                unexplained = np.where(covered, 0.0, self.power)
                if unexplained.sum() <= UNEXPLAINED_SHARE * self.power.sum():
                    return self._with_origins(points, tolerance, keep, covered)
        return self._with_origins(points, tolerance, keep, covered)

    def _with_origins(self, points: Array, tolerance: float, keep: Mask, covered: Mask) -> Mask:
        """Add places that first echoes without an origin agree on, to those that are kept.

        Beside a ground a leaf is a small part of the sound, yet what stands nearest to a pose is
        heard first, however faint it is.
        """
        known = np.isfinite(self.nearest)
        row = np.round((np.where(known, self.nearest, 0.0) - self.range[0]) / self.step)
        row = row.astype(int).clip(0, len(self.range) - 1)
        pose = np.arange(len(row))
        possible: Mask | None = None
        while True:
            asks = np.flatnonzero(known & ~covered[pose, row])
            if len(asks) < max(ORIGIN_POSES, UNEXPLAINED_SHARE * known.sum()):
                return keep
            if possible is None:
                possible = self.about(points, tolerance).possible & self._in_hull(points, tolerance)
            agree = np.where(possible & ~keep, self._origins(points, tolerance, asks), 0)
            if agree.max() < ORIGIN_POSES:
                return keep
            keep = keep | (agree >= AGREEMENT * agree.max())
            covered = self._covered(points[keep], tolerance)

    def _origins(self, points: Array, tolerance: float, asks: NDArray[np.intp]) -> Array:
        """Return how many of some first echoes can have come from each place, (N,)."""
        parts = []
        for start in range(0, len(points), CHUNK):
            distance = cdist(self.sources, points[start : start + CHUNK]).clip(1e-6)
            witness = self._witnesses(points[start : start + CHUNK], distance)[asks]
            near = np.abs(distance[asks] - self.nearest[asks, None]) <= tolerance + self.step
            parts.append((witness & near).sum(axis=0))
        return np.concatenate(parts)

    def _covered(self, points: Array, tolerance: float) -> Mask:
        """Return which range slices of each pose the places explain, (P, R)."""
        covered = np.zeros_like(self.heard)
        for start in range(0, len(points), CHUNK):
            _, row, within = self._rows(points[start : start + CHUNK])
            pose = np.broadcast_to(np.arange(len(row))[:, None], row.shape)
            covered[pose[within], row[within]] = True
        reach = int(np.ceil((tolerance + self.reach) / self.step))
        covered = ndimage.maximum_filter1d(covered, 2 * reach + 1, axis=1, mode="constant")
        return np.asarray(covered)
