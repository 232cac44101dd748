# SPDX-License-Identifier: MIT
"""Offsets, background and reference target of an import, put into what cuts its pings."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from sononerf.errors import InputError
from sononerf.head.head import Head
from sononerf.recordings.folder import read_sound
from sononerf.recordings.pings import Cutter, cut, mix
from sononerf.recordings.recording import Recording
from sononerf.recordings.reference import calibrate
from sononerf.settings.import_schema import ImportSettings


def calibrated(
    recording: Recording,
    wanted: ImportSettings,
    head: Head,
    folder: Path,
) -> tuple[Cutter, dict[str, Any]]:
    """Return what cuts pings, with background, reference and offsets, and what was applied.

    Parameters
    ----------
    recording : Recording
        All pings.
    wanted : ImportSettings
        What to apply.
    head : Head
        Gains, places, air, call and analysis.
    folder : Path
        Of background and reference.

    Returns
    -------
    cutter : Cutter
        Cuts and calibrates pings.
    applied : dict
        Plain data.
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
