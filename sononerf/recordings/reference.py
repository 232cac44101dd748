# SPDX-License-Identifier: MIT
r"""Calibration against the echo of a known sphere: level of each receiver, and range offset.

A rigid sphere of radius a, large against the wavelength, sends back a/2 of the pressure that falls
on it, at 1 m [1]_. Heard at distance r of its surface that is, of the call's pressure at 1 m,

.. math:: \frac{a}{2} \frac{10^{-\alpha (d_e + d_r) / 20}}{(d_e + a)(d_r + a)} G_e G_r

with :math:`d_e, d_r` from emitter and receiver to the surface and G the gains straight ahead.

References:
    .. [1] R. J. Urick, Principles of Underwater Sound, 3rd edition, 1983, table 9.1.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from sononerf.errors import InputError
from sononerf.head.call import call_waveform, covered, sweep_delay
from sononerf.head.ears import beam_gain, ear_gain
from sononerf.head.head import Head
from sononerf.head.spectrogram import frequency_axis, range_axis, spectrogram
from sononerf.settings.import_schema import ReferenceSettings
from sononerf.settings.schema import CallSettings, SpectrogramSettings

Array = NDArray[np.float64]

SEARCH = 0.25
"""The sphere's echo is looked for within this fraction of its distance, nearer and farther."""


@dataclass(frozen=True, eq=False)
class Calibration:
    """What the reference target says.

    Attributes:
        gain (E,): Factor that brings each receiver to the call's pressure at 1 m.
        range_offset (m): To be added to every range.
    """

    gain: Array
    range_offset: float


def calibrate(
    echo: Array,
    reference: ReferenceSettings,
    head: Head,
) -> Calibration:
    """Compare the echo of a reference target with what it should be.

    Args:
        echo (E, S): What the receivers heard of it, from the emission on.
        reference: The target.
        head: Gains, places, air, call and analysis; its range limits do not matter.

    Raises:
        InputError: If the recording ends before the target, or nothing is heard of it.
    """
    ears, call, speed_of_sound = head.gains, head.call, head.speed_of_sound
    absorption = head.absorption(head.frequency)
    near = head.analysis.model_copy(
        update={
            "hop": 1,
            "range_min": reference.distance * (1.0 - SEARCH),
            "range_max": reference.distance * (1.0 + SEARCH),
        }
    )
    frequency = frequency_axis(near)
    delay = sweep_delay(call, frequency)
    axis = range_axis(near, speed_of_sound)
    try:
        heard = spectrogram(echo, near, speed_of_sound, delay)
    except ValueError as error:
        raise InputError(f"import.reference: {error}") from None
    swept = covered(call, frequency)
    swept = swept if swept.any() else np.ones_like(swept)
    power = np.square(heard[..., swept]).mean(axis=-1)  # (E, R)
    top = power.argmax(axis=1)
    if not (power.max(axis=1) > 0.0).all() or (top == 0).any() or (top == len(axis) - 1).any():
        raise InputError(
            f"{reference.file}: no echo of the reference target within {100 * SEARCH:.0f} % of "
            f"{reference.distance:g} m; check import.reference.distance and time"
        )
    centre = ears.emitter + np.array([reference.distance + reference.radius, 0.0, 0.0])
    to_emitter = centre - ears.emitter
    to_ears = centre - ears.positions
    out = np.linalg.norm(to_emitter)
    back = np.linalg.norm(to_ears, axis=1)
    path = (out + back) / 2.0 - reference.radius
    gain = np.stack(
        [
            beam_gain(ears, to_emitter[None] / out)[0]
            * ear_gain(ears, ear, to_ears[ear : ear + 1] / back[ear])[0]
            for ear in range(len(back))
        ]
    )
    loss = 10.0 ** (-absorption[None] * 2.0 * path[:, None] / 20.0)
    expected = reference.radius / 2.0 * loss * gain / (out * back)[:, None]
    time, direct = _call_itself(call, near, delay)
    wanted = np.square(expected * direct.max(axis=0))[:, swept].mean(axis=1)
    found = np.take_along_axis(power, top[:, None], axis=1)[:, 0]
    # Rows at the ends of a sweep are lopsided, and so is the peak of their mean.
    profile = np.square(direct * expected[:, None])[..., swept].mean(axis=-1)
    bias = speed_of_sound / 2.0 * _peak(time, profile, profile.argmax(axis=1))
    offsets = path + bias - _peak(axis, power, top)
    return Calibration(np.sqrt(wanted / found), float(offsets.mean()))


def _call_itself(
    call: CallSettings, analysis: SpectrogramSettings, delay: Array
) -> tuple[Array, Array]:
    """Return the dechirped spectrogram (T, F) of the call, and its times (T,) s."""
    waveform, rate = call_waveform(call, analysis.sampling_rate), analysis.sampling_rate
    lead = len(waveform) + 2 * analysis.window
    # At a speed of 2 m/s ranges are seconds.
    own = analysis.model_copy(update={"range_min": 1e-12, "range_max": 2 * lead / rate})
    echo = np.zeros((1, 4 * lead + analysis.window + int(delay.max() * rate)))
    echo[0, lead : lead + len(waveform)] = waveform
    return range_axis(own, 2.0) - lead / rate, spectrogram(echo, own, 2.0, delay)[0]


def _peak(axis: Array, power: Array, top: NDArray[np.intp]) -> Array:
    """Return the ranges of the tops, between slices, (E,) m."""
    rows = np.arange(len(top))
    before, at, after = (np.log(power[rows, top + step] + 1e-300) for step in (-1, 0, 1))
    bend = 2.0 * at - before - after
    shift = np.where(bend > 1e-12, 0.5 * (after - before) / np.maximum(bend, 1e-12), 0.0)
    return axis[top] + shift.clip(-1, 1) * (axis[1] - axis[0])
