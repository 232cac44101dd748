# SPDX-License-Identifier: MIT
"""Objects as HTML for notebooks: a table of numbers and a small picture; spectrograms as sound."""

from __future__ import annotations

import base64
import html
import io
from functools import singledispatch
from typing import Any

import numpy as np
from numpy.typing import ArrayLike
from scipy.io import wavfile

from sononerf.echoes.echoes import Echoes
from sononerf.evaluation.numbers import Evaluation
from sononerf.evaluation.prediction import Prediction
from sononerf.geometry.poses import Poses
from sononerf.head.decibels import compress
from sononerf.head.head import Head
from sononerf.report.pictures.mesh_picture import confidence_png, mesh_png
from sononerf.report.pictures.spectrogram_picture import spectrogram_picture
from sononerf.scene.scene import Scene
from sononerf.surface.surface import Surface

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


Rows = list[tuple[str, str]]


def html_of(thing: object) -> str:
    """Return the HTML of an object: its kind, its numbers, and its picture where it has one."""
    rows = "".join(
        f"<tr><th style='text-align:left'>{html.escape(name)}</th>"
        f"<td style='text-align:left'>{html.escape(value)}</td></tr>"
        for name, value in rows_of(thing)
    )
    text = f"<b>{type(thing).__name__}</b><table>{rows}</table>"
    png = png_of(thing)
    if png is not None:
        data = base64.b64encode(png).decode()
        text += f"<img style='max-width:480px' alt='' src='data:image/png;base64,{data}'>"
    return text


@singledispatch
def rows_of(thing: object) -> Rows:
    """Return name and value of an object's numbers, as text."""
    return [("", repr(thing))]


@singledispatch
def png_of(thing: object, **options: Any) -> bytes | None:
    """Return the picture of an object as a PNG file; None where it has none."""
    del thing, options
    return None


def _extent(positions: np.ndarray[Any, Any]) -> str:
    return " x ".join(f"{1e3 * size:.4g}" for size in np.ptp(positions, axis=0)) + " mm"


@rows_of.register
def _(thing: Scene) -> Rows:
    return [
        ("triangles", f"{len(thing.mesh.faces):,}"),
        ("size", _extent(thing.mesh.vertices)),
        ("materials", str(len(thing.materials))),
    ]


@png_of.register
def _(thing: Scene, **options: Any) -> bytes | None:
    del options
    return mesh_png(thing.mesh)


@rows_of.register
def _(thing: Poses) -> Rows:
    distance = np.linalg.norm(thing.positions, axis=1)
    return [
        ("poses", str(len(thing))),
        ("distance from the origin", f"{distance.min():.4g} to {distance.max():.4g} m"),
    ]


@rows_of.register
def _(thing: Head) -> Rows:
    low, high = thing.frequency[[0, -1]] / 1e3
    near, far = thing.range[[0, -1]]
    return [
        ("receivers", f"{len(thing.receivers)}, {thing.ears.directivity}"),
        ("call", thing.call.kind),
        ("frequency", f"{low:.1f} to {high:.1f} kHz, {len(thing.frequency)} bins"),
        ("range", f"{near:.3f} to {far:.3f} m, {len(thing.range)} slices"),
        ("range resolution", f"{1e3 * thing.resolution:.2g} mm"),
        ("speed of sound", f"{thing.speed_of_sound:.1f} m/s"),
    ]


@rows_of.register
def _(thing: Echoes) -> Rows:
    train, validation, test = np.bincount(thing.store.split, minlength=3)
    counts = f"{train} train, {validation} validate, {test} held out"
    floor = thing.store.attributes.get("noise_floor_mae_db")
    known = [] if floor is None else [("noise floor", f"{floor:.2g} dB")]
    return [("poses", f"{len(thing)}: {counts}"), *rows_of(thing.head), *known]


@png_of.register
def _(thing: Echoes, *, pose: int | None = None, prediction: Prediction | None = None) -> bytes:
    number = int([*thing.store.indices("test"), 0][0]) if pose is None else pose
    measured = compress(thing.spectrogram(number), thing.reference)
    levels: tuple[Any, Any] = (measured, None)
    if prediction is not None:
        row = thing.numbers_of(prediction.poses).tolist().index(number)
        levels = (measured, compress(prediction.magnitude[row], thing.reference))
    return spectrogram_picture(*levels, thing.head.range, thing.head.frequency, f"pose {number}")


@rows_of.register
def _(thing: Surface) -> Rows:
    rows = [
        ("triangles", f"{len(thing.mesh.faces):,}"),
        ("size", _extent(thing.mesh.vertices)),
        ("found as", thing.method),
        ("refined", "yes" if thing.refined else "no"),
    ]
    if thing.error_db is not None:
        rows.append(("mismatch on validation poses", f"{thing.error_db:.2f} dB"))
    return rows


@png_of.register
def _(thing: Surface, **options: Any) -> bytes | None:
    del options
    seen = thing.confidence
    return mesh_png(thing.mesh) if seen is None else confidence_png(thing.mesh, seen)


@rows_of.register
def _(thing: Prediction) -> Rows:
    rows = [
        ("poses", str(len(thing.poses))),
        ("weight of traced echoes", f"{thing.traced_weight:.2f}"),
    ]
    return rows if thing.traced_fault is None else [*rows, ("not traced", thing.traced_fault)]


@png_of.register
def _(thing: Prediction, *, pose: int = 0) -> bytes:
    level = compress(thing.magnitude[pose], thing.reference)
    return spectrogram_picture(None, level, thing.range, thing.frequency, f"pose {pose}")


@rows_of.register
def _(thing: Evaluation) -> Rows:
    return thing.rows()
