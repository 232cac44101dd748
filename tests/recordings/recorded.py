# SPDX-License-Identifier: MIT
"""Recordings of a small sphere, made by formula, for tests of the import."""

from __future__ import annotations

import numpy as np

from sononerf.geometry.poses import look_at
from sononerf.head.call import call_waveform, emit
from sononerf.settings.schema import CallSettings

RATE, SPEED, RADIUS = 250_000, 343.0, 0.4
CALL = {"kind": "linear", "duration": 5e-4, "frequency_start": 80e3, "frequency_end": 20e3}
EARS = {
    "receivers": [[0, 0.03, 0], [0, -0.03, 0]],
    "emitter": [0, 0, 0],
    "directivity": "omnidirectional",
    "beam_radius": 0,
}
TARGET = np.array([0.02, 0.03, -0.01])


def poses(count=24):
    """Places on a spiral and rotations that look at the origin."""
    turn = np.arange(count) * 2.4
    height = np.linspace(-0.8, 0.8, count)
    level = np.sqrt(1 - height**2)
    places = RADIUS * np.stack([level * np.cos(turn), level * np.sin(turn), height], axis=1)
    return places, look_at(places, np.zeros(3))


def waveforms(count=24, samples=1600, noise=0.0, gain=0.2, receivers=EARS["receivers"], call=CALL):
    """What receivers hear of a point at :data:`TARGET`, from the emission on, (P, E, S)."""
    places, turns = poses(count)
    back = places[:, None] + np.einsum("pij,ej->pei", turns, np.asarray(receivers, float))
    out = np.linalg.norm(places - TARGET, axis=1)[:, None]
    path = out + np.linalg.norm(back - TARGET, axis=2)
    frequency = np.fft.rfftfreq(samples, 1 / RATE)
    turned = np.exp(-2j * np.pi * frequency * path[..., None] / SPEED)
    responses = np.fft.irfft(gain * turned / path[..., None] ** 2, samples)
    waveform = call_waveform(CallSettings(**call), RATE)
    heard = np.stack([emit(one, waveform)[:, :samples] for one in responses])
    return heard + noise * np.random.default_rng(0).standard_normal(heard.shape)


def arrays(**changes):
    """Arrays of the format `numpy`."""
    places, turns = poses()
    given = {
        "waveform": waveforms(),
        "sampling_rate": float(RATE),
        "position_m": places,
        "rotation": turns,
        **changes,
    }
    return {name: values for name, values in given.items() if values is not None}


SETTINGS = (
    f"ears={EARS}",
    f"call={CALL}",
    "spectrogram.frequency_max=80e3",
    "spectrogram.frequency_min=20e3",
)
