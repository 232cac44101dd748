# SPDX-License-Identifier: MIT
r"""Which frequencies a row of a spectrogram hears, and how much too late.

A filter of some bandwidth cannot tell frequencies apart that lie closer than that: a spectrum that
varies is smeared over it. Of an impulse the value at the middle of an echo is the spectrum's mean
under the filter's transform about its own time. A sweep's frequencies enter the filter one after
the other; by Parseval's theorem a row hears the mean power, each frequency weighted with the
squares of the filter's transform and of the call's spectrum.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from sononerf.head.call import call_waveform, sweep_delay
from sononerf.head.row_filters import BANDWIDTH, SKIRT, row_filters
from sononerf.head.spectrogram import frequency_axis
from sononerf.settings.schema import CallSettings, SpectrogramSettings

WIDEST = 8.0
"""A gammatone's skirt is followed down to this part of its own frequency at most."""


class Smearing(NamedTuple):
    """What the rows hear of fine frequencies.

    Attributes:
        frequency ((N,), Hz): The fine ones, ascending.
        rows (F, K): Which of them each row hears.
        weight ((F, K) float64 or complex128): How much: of a sound's pressure for an impulse, of
            its power for a sweep. The sum is 1, for complex weights its magnitude.
        later ((F, K) or None, s): The weight times how much later than the row's own frequency each
            one is emitted; None for an impulse.
    """

    frequency: NDArray[np.float64]
    rows: NDArray[np.int64]
    weight: NDArray[np.float64] | NDArray[np.complex128]
    later: NDArray[np.float64] | None


def smearing(call: CallSettings, analysis: SpectrogramSettings) -> Smearing:
    """Return what the rows of an analysis hear of a call.

    Args:
        call: What is emitted.
        analysis: Filters and frequencies.
    """
    return (_of_gammatones if analysis.kind == "gammatone" else _of_a_window)(call, analysis)


def _of_a_window(call: CallSettings, analysis: SpectrogramSettings) -> Smearing:
    wanted = frequency_axis(analysis)
    step = analysis.sampling_rate / analysis.fft
    window = np.hamming(analysis.window)
    # The transform about the window's own middle is real; two main lobes on each side suffice.
    reach = math.ceil(4.0 * analysis.fft / analysis.window)
    time = np.arange(analysis.window) - (analysis.window - 1) / 2.0
    offsets = np.arange(-reach, reach + 1)
    smear = np.cos(2.0 * np.pi / analysis.fft * np.outer(offsets, time)) @ window
    first = round(float(wanted[0]) / step) - reach
    count = len(wanted) + 2 * reach
    # Below the first bin and above half the sampling rate there is nothing to hear.
    bins = np.clip(np.arange(first, first + count), 1, analysis.fft // 2)
    fine = bins.clip(1) * step + np.arange(count) * 1e-9
    rows = np.arange(len(wanted))[:, None] + np.arange(2 * reach + 1)  # (F, K) of the fine bins
    if call.kind == "impulse":
        return Smearing(fine, rows, np.tile(smear / smear.sum(), (len(wanted), 1)), None)
    waveform = call_waveform(call, analysis.sampling_rate)
    finer = math.ceil(len(waveform) / analysis.fft)
    emitted = np.fft.rfft(waveform, finer * analysis.fft)[finer * bins]
    weight = smear**2 * (np.abs(emitted) ** 2)[rows]
    weight /= weight.sum(axis=1, keepdims=True)
    delay = sweep_delay(call, bins * step)
    return Smearing(fine, rows, weight, weight * (delay[rows] - sweep_delay(call, wanted)[:, None]))


def _of_gammatones(call: CallSettings, analysis: SpectrogramSettings) -> Smearing:
    filters, rate = row_filters(analysis), analysis.sampling_rate
    wanted = filters.frequency
    # Fine frequencies are some to a channel, and some to a bandwidth, in equal ratios too.
    between = math.log(wanted[-1] / wanted[0]) / (len(wanted) - 1)
    finer = max(1, math.ceil(4.0 * analysis.q * between))
    step = between / finer
    skirt = SKIRT * BANDWIDTH / analysis.q
    below = math.ceil(-math.log(max(1.0 - skirt, 1.0 / WIDEST)) / step)
    above = math.ceil(math.log(1.0 + skirt) / step)
    count = finer * (len(wanted) - 1) + 1 + below + above
    exact = wanted[0] * np.exp(step * (np.arange(count) - below))
    fine = np.minimum(exact, rate / 2.0) + np.arange(count) * 1e-9
    rows = finer * np.arange(len(wanted))[:, None] + np.arange(below + above + 1)
    time = np.arange(filters.envelope.shape[1]) + filters.origin - filters.centre
    turn = 2j * np.pi / rate * time
    weight = np.stack(
        [
            np.exp(np.outer(exact[which] - row, turn)) @ envelope
            for which, row, envelope in zip(rows, wanted, filters.envelope, strict=True)
        ]
    )
    # A fine frequency stands for a part of the axis that grows with it.
    weight *= np.where(exact <= rate / 2.0, exact, 0.0)[rows]
    if call.kind == "impulse":
        return Smearing(fine, rows, weight / abs(weight.sum(axis=1, keepdims=True)), None)
    waveform = call_waveform(call, rate)
    sample = np.arange(len(waveform))
    emitted = np.array([waveform @ np.exp(-2j * np.pi / rate * each * sample) for each in fine])
    power = np.abs(weight) ** 2 / exact[rows] * (np.abs(emitted) ** 2)[rows]
    power /= np.maximum(power.sum(axis=1, keepdims=True), 1e-300)
    delay = sweep_delay(call, fine)
    return Smearing(fine, rows, power, power * (delay[rows] - sweep_delay(call, wanted)[:, None]))
