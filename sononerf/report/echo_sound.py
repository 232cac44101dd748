# SPDX-License-Identifier: MIT
"""Spectrograms as sound that people can hear."""

from __future__ import annotations

import io

import numpy as np
from numpy.typing import ArrayLike
from scipy.io import wavfile

STRETCH = 10.0
"""Factor by which an echo is longer and lower in pitch: 20 to 100 kHz become 2 to 10 kHz."""
RATE = 44_100
"""Sampling rate, Hz; every player supports it."""
PAUSE = 0.25
"""Silence before and after the echo, s, because some players cut off the first milliseconds."""
LOUDEST = 0.8
"""Largest sample, as a fraction of full scale, so that nothing clips."""


def echo_wav(
    magnitude: ArrayLike, range_m: ArrayLike, frequency_hz: ArrayLike, speed_of_sound: float
) -> bytes:
    """Return the echo of a pose as a WAV file, ten times longer and lower.

    A spectrogram has no phase. The sound is a sum of one tone per frequency; each tone has the
    magnitude of the spectrogram over time, and a random phase that is the same in every call. The
    left channel is the left ear.

    In: magnitude (E, R, F), range_m ((R,), m), frequency_hz ((F,), Hz), speed_of_sound (m/s).
    """
    heard = np.asarray(magnitude, dtype=np.float64)[:2]
    ranges, frequencies = np.asarray(range_m, dtype=float), np.asarray(frequency_hz, dtype=float)
    arrival = STRETCH * 2.0 * (ranges - ranges[0]) / speed_of_sound
    time = np.arange(int(arrival[-1] * RATE) + 1) / RATE
    low = frequencies / STRETCH
    audible = low < RATE / 2
    phase = np.random.default_rng(0).uniform(0.0, 2.0 * np.pi, len(low))
    tones = np.cos(2.0 * np.pi * low * time[:, None] + phase) * audible
    place = np.interp(time, arrival, np.arange(len(ranges)))
    before = np.minimum(place.astype(int), max(len(ranges) - 2, 0))
    after, part = np.minimum(before + 1, len(ranges) - 1), (place - before)[:, None]
    waves = np.stack(
        [(tones * ((1 - part) * one[before] + part * one[after])).sum(axis=1) for one in heard],
        axis=1,
    )
    top = np.abs(waves).max()
    silence = np.zeros((int(PAUSE * RATE), waves.shape[1]))
    samples = np.concatenate([silence, waves * (LOUDEST / top if top > 0 else 0.0), silence])
    file = io.BytesIO()
    wavfile.write(file, RATE, (samples * 32767).astype(np.int16))
    return file.getvalue()
