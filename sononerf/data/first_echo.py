# SPDX-License-Identifier: MIT
"""When each ear heard its first echo."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from sononerf.data.noise_tops import noise_tops
from sononerf.data.store import EnsembleStore

Array = NDArray[np.float64]
MOST_POSES = 1000
"""So many training poses are asked for their first echoes, evenly over all. What more of them would
sharpen lies below what an echo's onset can be read to; what all have heard is paired with one
another where the surface is drawn, and would no longer fit in memory."""
FAINTEST_DB = 40.0
"""Below the pose's loudest. What is fainter may be the skirt of the window, no echo."""
FAINT_DB = 20.0
"""Below the zero of the reported decibels: so faint is a thin sheet's edge beside its flash. Where
noise does not lie that far below a pose's loudest, what is nearest may have answered under it."""
EVEN_DB = 4.0
"""Quantiles of noise as one ear hears it lie no farther apart."""
ONSET_DB = 10.0
"""Below an echo's top: where it has risen to this its place is read, for there the next one, which
may follow closely, has not begun."""


def asked_poses(store: EnsembleStore) -> NDArray[np.int64]:
    """Return the numbers of the training poses that are asked for their first echoes, ascending."""
    train = np.asarray(store.indices("train"))
    chosen = np.linspace(0, len(train) - 1, min(MOST_POSES, len(train))).round().astype(int)
    return np.asarray(train[chosen])


def first_echoes(store: EnsembleStore, window: Array, step: float) -> Array:
    """Return the range of the first echo at each ear of each asked pose.

    Parameters
    ----------
    store : EnsembleStore
        A sealed ensemble; only its :func:`asked_poses` are looked at.
    window : (W,) float
        Power of a point echo over range.
    step : float, m
        Between its values.

    Returns
    -------
    first : (P, E) float, m
        Minus infinity where nothing was heard.
    """
    rise = _rise(window) * step
    axis = np.asarray(store.range, dtype=np.float64)
    floor = float(store.attributes["reference"]) ** 2
    heard = []
    for index in asked_poses(store):
        power = np.square(store.read_pose(int(index)), dtype=np.float64).mean(axis=-1)
        heard.append([_first(profile, axis, floor) + rise for profile in power])
    return np.asarray(heard)


def _rise(window: Array) -> float:
    """Return how many steps lie between an echo's onset and its middle."""
    middle = int(window.argmax())
    before = np.flatnonzero(window[: middle + 1] < window[middle] * 10 ** (-ONSET_DB / 10))
    return middle - _crossing(window, int(before[-1]), window[middle]) if len(before) else 0.0


def _first(power: Array, axis: Array, floor: float) -> float:
    """Return the range at which the first echo has risen to the onset."""
    inner = power[1:-1]
    noise, noisy = noise_tops(power, EVEN_DB)
    if noisy and noise > floor:
        if power.max() < noise * 10 ** (FAINT_DB / 10):
            return -np.inf
        floor = float(noise)
    else:
        floor = min(floor, max(float(noise), floor * 10 ** (-FAINT_DB / 10)))
    least = max(floor, power.max() * 10 ** (-FAINTEST_DB / 10))
    tops = (inner >= power[:-2]) & (inner > power[2:]) & (inner > least)
    if not tops.any() or (power[0] > least and power[0] >= power[1]):
        return -np.inf  # nothing was heard, or something whose end alone was heard
    top = int(tops.argmax()) + 1
    before = np.flatnonzero(power[:top] < power[top] * 10 ** (-ONSET_DB / 10))
    if not len(before):
        return -np.inf  # it began before the first slice
    return float(np.interp(_crossing(power, int(before[-1]), power[top]), range(len(axis)), axis))


def _crossing(power: Array, before: int, top: float) -> float:
    """Return where, between one index and the next, the decibels rise through the onset."""
    low, high = np.log10(np.maximum(power[before : before + 2], 1e-30 * top))
    wanted = np.log10(top) - ONSET_DB / 10
    return before + float((wanted - low) / (high - low))
