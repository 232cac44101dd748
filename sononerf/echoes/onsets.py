# SPDX-License-Identifier: MIT
"""The range of the first echo at each ear of each pose, and which slices hold an echo."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.stats import poisson

from sononerf.echoes.detection import FALSE_ALARMS, Levels, onsets, threshold_levels
from sononerf.echoes.store import EnsembleStore
from sononerf.head.point_echo import PointEcho
from sononerf.head.row_filters import band_mean

Array = NDArray[np.float64]
Mask = NDArray[np.bool_]
MOST_POSES = 1000
"""How many training poses are asked, evenly over all, so that memory is bounded. More of them add
less to the free space than an onset can be read to."""


@dataclass(frozen=True, eq=False)
class Onsets:
    """What the asked poses heard.

    Attributes
    ----------
    poses : (P,) int
        Their numbers in the store, ascending.
    range : (R,) float, m
        Of the slices.
    power : (P, E, R) float
        Averaged over the band.
    heard : (P, E, R) bool
        Which slices hold an echo.
    first : (P, E) float, m
        Range of the first echo; minus infinity where there is none, or where it is cut.
    """

    poses: NDArray[np.int64]
    range: Array
    power: Array
    heard: Mask
    first: Array

    def chance(self, resolution: float) -> float:
        """Return the probability that noise alone makes so many onsets.

        Parameters
        ----------
        resolution : float, m
            Range resolution: as many slices as it is long share their noise.
        """
        extent = len(self.range) * float(self.range[1] - self.range[0])
        tries = self.first.size * extent / resolution
        return float(poisson.sf(np.isfinite(self.first).sum() - 1, FALSE_ALARMS * tries))


def asked_poses(store: EnsembleStore) -> NDArray[np.int64]:
    """Return the numbers of the training poses that are asked, ascending."""
    train = np.asarray(store.indices("train"))
    chosen = np.linspace(0, len(train) - 1, min(MOST_POSES, len(train))).round().astype(int)
    return np.asarray(train[chosen])


def find_onsets(store: EnsembleStore, echo: PointEcho) -> Onsets:
    """Detect the echoes of a sealed ensemble's asked poses.

    Parameters
    ----------
    store : EnsembleStore
        The ensemble.
    echo : PointEcho
        What the analysis makes of one point.
    """
    poses = asked_poses(store)
    axis = np.asarray(store.range, dtype=np.float64)
    heard = (np.square(store.read_pose(int(i)), dtype=np.float64) for i in poses)
    if echo.rows is None:
        power = np.stack([each.mean(axis=-1) for each in heard])
    else:
        power = np.stack([band_mean(each, store.frequency) for each in heard])
    levels = threshold_levels(power, echo.looks)
    step = float(axis[1] - axis[0])
    fineness = echo.spacing / step
    found = []
    for ear in range(power.shape[1]):

        def own_window(row: int, top: int, ear: int = ear) -> Array:
            return echo.of_spectrum(store.read_pose(int(poses[row]))[ear, top])

        window = echo.window if echo.rows is None else own_window
        level = Levels(*(each[:, ear] for each in levels))
        found.append(onsets(power[:, ear], level, window, fineness))
    first = axis[0] + step * np.stack(found, axis=1)
    return Onsets(poses, axis, power, power > levels.total, first)
