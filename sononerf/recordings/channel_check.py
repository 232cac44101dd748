# SPDX-License-Identifier: MIT
"""Check of a recording's channels: level, noise, and how often each heard an echo."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from sononerf.array_types import Floats
from sononerf.echoes.detection import RANK, threshold_levels
from sononerf.errors import InputError
from sononerf.recordings.audio import Recording
from sononerf.recordings.pings import mix
from sononerf.settings.import_schema import Channels

DEAF = 0.35
"""A channel counts as deaf if it heard echoes in less than this fraction of the pings in which
another channel heard one, no unit. Receivers beside one another hear the same body, and noise that
was pulse-compressed gives a false echo in up to a quarter of the pings."""
FAINT_DB = 40.0
"""A channel counts as faint if its echoes are weaker than the strongest channel's by more, dB: ears
that look apart differ by 20 to 30 dB."""
LOOKED_AT = 16
"""Number of pings whose samples are compared; a broken cable shows in all."""


@dataclass(frozen=True)
class Channel:
    """State of one channel, over the pings that were checked.

    Attributes:
        level_db (dB): Its loudest echo over that of the loudest channel; the median of the pings.
            Minus infinity if the channel is silent.
        noise_db (dB): The quietest tenth of its ranges over its own loudest echo; the median.
        heard: In how many pings it heard an echo.
        asked: Number of pings that were checked.
    """

    level_db: float
    noise_db: float
    heard: int
    asked: int


def channels_of(power: Floats, looks: float) -> list[Channel]:
    """Return the state of each channel.

    In: power (P, E, R).
    """
    heard = (power > threshold_levels(power, looks).total).any(axis=-1).sum(axis=0)
    loud = np.median(power.max(axis=-1), axis=0)
    noise = np.median(np.quantile(power, RANK, axis=-1), axis=0)
    with np.errstate(divide="ignore", invalid="ignore"):
        level = 10.0 * np.log10(loud / loud.max())
        floor = 10.0 * np.log10(noise / loud)
    return [
        Channel(float(one), float(other), int(count), len(power))
        for one, other, count in zip(level, floor, heard, strict=True)
    ]


def faults_of_channels(channels: list[Channel]) -> list[str]:
    """Return the faults of channels that the others contradict, one line each."""
    most = max(channel.heard for channel in channels)
    faults = []
    for number, channel in enumerate(channels):
        if channel.heard < DEAF * most:
            faults.append(
                f"channel {number} heard echoes in {channel.heard} of {channel.asked} pings, and "
                f"another one in {most}: is its microphone connected? Leave it out with "
                "import.channels and ears.receivers"
            )
        elif channel.level_db < -FAINT_DB:
            faults.append(
                f"channel {number} is {-channel.level_db:.0f} dB fainter than the loudest one: is "
                "its gain right?"
            )
    return faults


def check_channels(recording: Recording, channels: Channels | None) -> None:
    """Refuse a channel that is silent, or equal to another one, in all pings that are looked at."""
    asked = np.linspace(0, len(recording) - 1, min(LOOKED_AT, len(recording))).round().astype(int)
    contents = []
    for ping in np.unique(asked).tolist():
        samples = mix(np.asarray(recording.read(ping)), channels)
        constant = (samples == samples[:, :1]).all(axis=1)
        contents.append(
            [b"" if flat else row.tobytes() for flat, row in zip(constant, samples, strict=True)]
        )
    of_channels = [b"".join(parts) for parts in zip(*contents, strict=True)]
    if not any(of_channels):
        return
    way_out = "leave it out with import.channels and ears.receivers"
    for number, content in enumerate(of_channels):
        if not content:
            raise InputError(
                f"{recording.path}: channel {number} is silent in all pings; check its cable, or "
                f"{way_out}"
            )
        if (first := of_channels.index(content)) < number:
            raise InputError(
                f"{recording.path}: channels {first} and {number} hold the same samples; check the "
                f"recorder, or {way_out}"
            )
