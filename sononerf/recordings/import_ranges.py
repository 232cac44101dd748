# SPDX-License-Identifier: MIT
"""Between which ranges recordings are analysed, where the settings leave it open."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from sononerf.echoes.extent import echo_extent
from sononerf.echoes.onsets import PointEcho
from sononerf.errors import InputError
from sononerf.head.air import speed_in
from sononerf.head.reception import Reception
from sononerf.head.spectrogram import range_axis
from sononerf.recordings.pings import Cutter
from sononerf.recordings.recording import Recording
from sononerf.settings.schema import Settings, validate_settings

Array = NDArray[np.float64]

ASKED = 64
"""So many pings, evenly over all, are asked for ranges and noise."""


def reception_of(settings: Settings) -> Reception:
    """Return call and analysis of settings."""
    speed = speed_in(settings.air)
    return Reception(settings.call, settings.spectrogram, settings.noise, speed_of_sound=speed)


def with_ranges(
    settings: Settings, cutter: Cutter, recording: Recording, data: dict[str, Any]
) -> tuple[Settings, Array]:
    """Set range limits that are left out from the echoes.

    Parameters
    ----------
    settings : Settings
        Air, ears, call and analysis.
    cutter : Cutter
        Cuts the pings.
    recording : Recording
        All pings.
    data : dict
        The settings as given; limits that are not in it follow from the echoes.

    Returns
    -------
    settings : Settings
        With both limits.
    power : (P, E, R) float
        Of some pings over all ranges, averaged over frequency.

    Raises
    ------
    InputError
        If the recordings are too short, or begin too late, for limits that are set.
    """
    analysis, speed = settings.spectrogram, speed_in(settings.air)
    rate = analysis.sampling_rate
    count = min(cutter.samples(index) for index in range(len(recording)))
    begins = max(cutter.begins(index) for index in range(len(recording)))
    metre = speed / 2.0 / rate  # of a sample
    longest = float(reception_of(settings).delay.max())
    whole = _widest(analysis.window, count, longest * rate, metre)
    emitter = np.asarray(settings.ears.emitter)
    places = settings.ears.receivers
    apart = np.linalg.norm(
        np.asarray([settings.ears.left] if places is None else places) - emitter, axis=1
    )
    # The call itself comes first, as long as a window smears it.
    dead = float(apart.max()) / 2.0 + 2.0 * analysis.window * metre
    first = max(dead, (begins + analysis.window / 2.0) * metre)
    given = data.get("spectrogram", {})
    low = analysis.range_min if "range_min" in given else first
    high = analysis.range_max if "range_max" in given else whole
    if low < (begins + (analysis.window - 1) / 2.0) * metre - metre:
        raise InputError(
            f"{recording.path}: a recording begins after spectrogram.range_min ({low:g} m); raise "
            "it, or leave it out"
        )
    if not low < high:
        raise InputError(
            f"{recording.path}: the recordings end {whole:.3g} m after the emission, before "
            f"anything can be heard from {low:.3g} m on; check column time and its unit"
        )
    chosen = {"range_min": low, "range_max": high}
    wide = settings.model_copy(update={"spectrogram": analysis.model_copy(update=chosen)})
    reception = reception_of(wide)
    if reception.samples > count:
        raise InputError(
            f"{recording.path}: the recordings end {whole:.4g} m after the emission, before "
            f"spectrogram.range_max ({high:g} m); lower it, or leave it out"
        )
    pings = np.linspace(0, len(recording) - 1, min(ASKED, len(recording))).round().astype(int)
    power = np.stack(
        [
            np.square(reception.analyse(cutter.echo(int(i), reception.samples))).mean(axis=-1)
            for i in np.unique(pings)
        ]
    )
    echo = PointEcho.of(settings.call, analysis, speed)
    axis = range_axis(wide.spectrogram, speed)
    found = echo_extent(power, axis, echo.looks, 2.0 * echo.resolution)
    limits = {
        "range_min": low if "range_min" in given else round(found[0], 4),
        "range_max": high if "range_max" in given else round(found[1], 4),
    }
    plain = settings.plain()
    plain["spectrogram"] |= limits
    return validate_settings(plain, settings.source or "import"), power


def _widest(window: int, count: int, delay: float, metre: float) -> float:
    """Return the greatest range (m) whose frame lies in so many samples."""
    return (count - np.ceil(delay) - 1.0 - window / 2.0) * metre
