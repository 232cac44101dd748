# SPDX-License-Identifier: MIT
"""From single echoes with a strength per frequency to the pressure at an ear.

Each echo is laid into fine time bins, one row of bins per frequency node; a row is then filtered,
once, with the part of the spectrum that its node stands for. Synthesis is linear in the
strengths, so this equals a filter per echo.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import scipy.fft
from numpy.typing import NDArray

from sononerf.acoustics.spectrogram import echo_samples
from sononerf.config import SpectrogramSettings

LOWEST_NODE = 5e3  # Hz
HIGHEST_NODE = 150e3  # Hz
NODE_SPACING = 11.2e3  # Hz; 14 nodes over the band above
OVERSAMPLING = 4
GUARD = 512  # samples behind the last frame, for what filters put before and after an echo


@dataclass(frozen=True, eq=False)
class Synthesis:
    """Time bins, frequency nodes and the filters that join them.

    Attributes
    ----------
    nodes : (F,) float64, Hz
        Where strengths are wanted.
    basis : (F, K) complex128
        Spectrum that each node stands for, times ``j f`` in Hz.
    sampling_rate : float, Hz
        Of the echo.
    samples : int
        Length of the echo, S.
    length : int
        Of the transform, at the sampling rate.
    """

    nodes: NDArray[np.float64]
    basis: NDArray[np.complex128]
    sampling_rate: float
    samples: int
    length: int


def plan_synthesis(settings: SpectrogramSettings, speed_of_sound: float) -> Synthesis:
    """Lay out nodes and filters for an analysis.

    Between neighbouring nodes strengths run straight; below the lowest they stay, and above the
    highest they fall smoothly to zero within a third of it. The factor ``j f`` that every
    reflection has is part of the filters: a flat reflection is then a short derivative pulse and
    no long tail.

    Parameters
    ----------
    settings : SpectrogramSettings
        The analysis the echo is made for.
    speed_of_sound : float, m/s
        Of the medium.

    Returns
    -------
    synthesis : Synthesis
        For an echo that reaches to the end of the last frame.
    """
    rate = settings.sampling_rate
    top = min(max(HIGHEST_NODE, 1.2 * settings.frequency_max), 0.45 * rate)
    bottom = min(LOWEST_NODE, top / 2.0)
    count = max(2, 1 + round((top - bottom) / NODE_SPACING))
    nodes = np.linspace(bottom, top, count)
    samples = echo_samples(settings, speed_of_sound)
    length = int(scipy.fft.next_fast_len(samples + GUARD, real=True))
    length += length % 2
    frequency = np.fft.rfftfreq(length, 1.0 / rate)
    hats = np.stack([np.interp(frequency, nodes, row) for row in np.eye(count)])
    end = min(top * 4.0 / 3.0, rate / 2.0)
    fall = np.clip((frequency - top) / (end - top), 0.0, 1.0)
    # Laying an echo between two bins damps it by this much, on average over where it falls.
    damping = np.sinc(frequency / (OVERSAMPLING * rate)) ** 2
    shape = 1j * frequency * 0.5 * (1.0 + np.cos(np.pi * fall)) / damping
    return Synthesis(nodes, hats * shape, rate, samples, length)


def deposit(
    synthesis: Synthesis, delay: NDArray[np.float64], strength: NDArray[np.float64]
) -> NDArray[np.float64]:
    """Lay echoes into fine time bins, each between the two nearest.

    Parameters
    ----------
    synthesis : Synthesis
        The bins.
    delay : (N,) float64, s
        From the emission; echoes too late for the last frame are left out.
    strength : (N, F) float64
        Per node.

    Returns
    -------
    bins : (F, OVERSAMPLING * length) float64
        Sums of strengths.
    """
    place = delay * (synthesis.sampling_rate * OVERSAMPLING)
    heard = place < OVERSAMPLING * (synthesis.samples + GUARD // 2)
    place, strength = place[heard], strength[heard]
    index = place.astype(np.int64)
    late = (place - index)[:, None] * strength
    early = strength - late
    size = OVERSAMPLING * synthesis.length
    both = np.concatenate([index, index + 1])
    weights = np.ascontiguousarray(np.concatenate([early, late]).T)
    return np.stack([np.bincount(both, row, minlength=size) for row in weights])


def synthesise(synthesis: Synthesis, bins: NDArray[np.float64]) -> NDArray[np.float64]:
    """Filter each node's bins with its part of the spectrum, and add up.

    Parameters
    ----------
    synthesis : Synthesis
        The filters.
    bins : (..., F, OVERSAMPLING * length) float64
        From :func:`deposit`.

    Returns
    -------
    echo : (..., S) float64
        Pressure for a call that is one sample of height 1, at the sampling rate.
    """
    kept = synthesis.length // 2 + 1
    spectrum = (scipy.fft.rfft(bins, axis=-1)[..., :kept] * synthesis.basis).sum(axis=-2)
    echo: NDArray[np.float64] = scipy.fft.irfft(spectrum, n=synthesis.length, axis=-1)
    return echo[..., : synthesis.samples]
