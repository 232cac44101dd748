# SPDX-License-Identifier: MIT
"""What an import finds out by itself: the ranges to analyse, and the calibration."""

from __future__ import annotations

import dataclasses
from collections.abc import Collection
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from sononerf.echoes.region import echo_extent
from sononerf.errors import InputError
from sononerf.head.head import Head
from sononerf.recordings.folder import read_sound
from sononerf.recordings.pings import Cutter, cut, mix
from sononerf.recordings.reference import calibrate
from sononerf.recordings.writer import Recording
from sononerf.settings.import_schema import ImportSettings

Array = NDArray[np.float64]

ASKED = 64
"""So many pings, evenly over all, are asked for ranges and noise."""


def found_ranges(
    head: Head, cutter: Cutter, recording: Recording, given: Collection[str]
) -> tuple[dict[str, float], Array]:
    """Find range limits that are left out from the echoes.

    Args:
        head: Air, receivers, call and analysis.
        cutter: Cuts the pings.
        recording: All pings.
        given: Keys of the analysis that are set; limits that are not among them follow from the
            echoes.

    Returns:
        limits: ``range_min`` and ``range_max``, m.
        power (P, E, R): Of some pings over all ranges, averaged over frequency.

    Raises:
        InputError: If the recordings are too short, or begin too late, for limits that are set.
    """
    analysis, speed = head.analysis, head.speed_of_sound
    rate = analysis.sampling_rate
    count = min(cutter.samples(index) for index in range(len(recording)))
    begins = max(cutter.begins(index) for index in range(len(recording)))
    metre = speed / 2.0 / rate  # of a sample
    longest = float(head.delay.max())
    whole = _widest(analysis.window, count, longest * rate, metre)
    apart = np.linalg.norm(head.receivers - head.emitter, axis=1)
    # The call itself comes first, as long as a window smears it.
    dead = float(apart.max()) / 2.0 + 2.0 * analysis.window * metre
    first = max(dead, (begins + analysis.window / 2.0) * metre)
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
    wide = dataclasses.replace(head, analysis=analysis.model_copy(update=chosen))
    if wide.samples > count:
        raise InputError(
            f"{recording.path}: the recordings end {whole:.4g} m after the emission, before "
            f"spectrogram.range_max ({high:g} m); lower it, or leave it out"
        )
    pings = np.linspace(0, len(recording) - 1, min(ASKED, len(recording))).round().astype(int)
    power = np.stack(
        [
            np.square(wide.analyse(cutter.echo(int(i), wide.samples))).mean(axis=-1)
            for i in np.unique(pings)
        ]
    )
    found = echo_extent(power, wide.range, head.point_echo.looks, 2.0 * head.resolution)
    limits = {
        "range_min": low if "range_min" in given else round(found[0], 4),
        "range_max": high if "range_max" in given else round(found[1], 4),
    }
    return limits, power


def _widest(window: int, count: int, delay: float, metre: float) -> float:
    """Return the greatest range (m) whose frame lies in so many samples."""
    return (count - np.ceil(delay) - 1.0 - window / 2.0) * metre


def calibrated(
    recording: Recording,
    wanted: ImportSettings,
    head: Head,
    folder: Path,
) -> tuple[Cutter, dict[str, Any]]:
    """Return what cuts pings, with background, reference and offsets, and what was applied.

    Args:
        recording: All pings.
        wanted: What to apply.
        head: Gains, places, air, call and analysis.
        folder: Of background and reference.

    Returns:
        cutter: Cuts and calibrates pings.
        applied: Plain data.
    """
    speed, rate = head.speed_of_sound, recording.sampling_rate
    applied: dict[str, Any] = {
        "scale": wanted.scale,
        "time_offset_s": wanted.time_offset,
        "range_offset_m": wanted.range_offset,
    }
    # An echo from farther away comes later; the emission is moved the other way.
    delay = wanted.time_offset - 2.0 * wanted.range_offset / speed
    cutter = Cutter(recording, wanted.channels, delay, wanted.scale)
    if wanted.background is not None:
        quiet = _beside(folder / wanted.background, recording, wanted)
        begin = wanted.background_time + delay
        background = cut(quiet, begin * rate, quiet.shape[1] - int(begin * rate))
        cutter = replace(cutter, background=background)
        applied["background"] = wanted.background.name
    if wanted.reference is not None:
        target = wanted.reference
        heard = _beside(folder / target.file, recording, wanted)
        begin = (target.time + delay) * rate
        echo = cut(heard, begin, heard.shape[1] - int(begin))
        if cutter.background is not None:
            size = min(echo.shape[1], cutter.background.shape[1])
            echo[:, :size] -= cutter.background[:, :size]
        found = calibrate(
            mix(echo, wanted.channels) * wanted.scale,
            target,
            head,
        )
        delay -= 2.0 * found.range_offset / speed
        cutter = replace(cutter, delay=delay, gain=wanted.scale * found.gain)
        if cutter.background is not None:
            begin = wanted.background_time + delay
            background = cut(quiet, begin * rate, quiet.shape[1] - int(begin * rate))
            cutter = replace(cutter, background=background)
        applied["reference"] = {
            "file": target.file.name,
            "gain_db": np.round(20.0 * np.log10(found.gain), 3).tolist(),
            "range_offset_m": round(found.range_offset, 6),
        }
    return cutter, applied


def _beside(path: Path, recording: Recording, wanted: ImportSettings) -> NDArray[Any]:
    """Read another recording of the same rate and channels."""
    rate, samples = read_sound(path, wanted)
    channels = recording.read(0).shape[0]
    if rate != recording.sampling_rate or len(samples) != channels:
        raise InputError(
            f"{path}: {len(samples)} channels at {rate:g} Hz, the pings have {channels} at "
            f"{recording.sampling_rate:g} Hz; all must have the same"
        )
    return samples
