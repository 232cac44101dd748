# SPDX-License-Identifier: MIT
"""Impulse responses of the MATLAB programs SonoTraceLab and SonoNERF.

``sononerf-matlab`` is the file that SonoNERF's first script writes: a cell ``dataStorageMatrix``
of structs with ``impulseResponse`` (S, E) and ``sensorInfo``: ``position``, ``orientation`` (roll,
pitch, yaw in degrees), ``coordsEmitter`` and ``coordsReceivers``, in metres. It does not say its
sampling rate; its script simulates at 1 MHz with 343 m/s.

``sonotracelab`` is a workspace with ``structSensor``, ``structSimulationResult`` and
``structSimulationParameters``, each a struct or a cell of one per pose, as its examples make them.

Both programs turn about z, y, x with positive pitch looking down, as we do. Their responses are
filtered without delay, from the emission on. Emitter and microphones of both are the same in all
directions; SonoNERF's ears are filters that its second script applies.
"""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from sononerf.errors import InputError
from sononerf.matlab_files import as_list, read_mat, vector
from sononerf.recordings.audio import Recording
from sononerf.recordings.columns import Columns
from sononerf.settings.import_schema import ImportSettings

SONONERF_RATE, SONONERF_SPEED = 1e6, 343.0  # Hz, m/s: of its first script


def read_sononerf_matlab(path: Path, settings: ImportSettings) -> Recording:
    """Read the format ``sononerf-matlab``; see the module."""
    stored = read_mat(path, ("dataStorageMatrix",)).get("dataStorageMatrix")
    if stored is None:
        raise InputError(f"{path}: holds no dataStorageMatrix; is it of the format sonotracelab?")
    pings = as_list(stored)
    rate = settings.sampling_rate or SONONERF_RATE
    sensors = [_field(path, ping, "sensorInfo") for ping in pings]
    return _recording(
        path,
        responses=[_field(path, ping, "impulseResponse") for ping in pings],
        sensors=sensors,
        rate=rate,
        speed=SONONERF_SPEED,
    )


def read_sonotracelab(path: Path, settings: ImportSettings) -> Recording:
    """Read the format ``sonotracelab``; see the module."""
    names = ("structSensor", "structSimulationResult", "structSimulationParameters")
    found = read_mat(path, names)
    missing = [name for name in names[:2] if name not in found]
    if missing:
        raise InputError(f"{path}: holds no {missing[0]}; is it of the format sononerf-matlab?")
    sensors, results = (as_list(found[name]) for name in names[:2])
    if len(sensors) != len(results):
        raise InputError(f"{path}: {len(results)} pings and {len(sensors)} poses (structSensor)")
    said = as_list(found.get(names[2], {}))[0]
    rate = settings.sampling_rate
    if rate is None:
        rate = float(vector(path, said, "sampleRateImpresp", 1)[0])
    has_speed = isinstance(said, dict) and "speedOfSound" in said
    return _recording(
        path,
        responses=[_field(path, result, "impulseResponse") for result in results],
        sensors=sensors,
        rate=rate,
        speed=float(vector(path, said, "speedOfSound", 1)[0]) if has_speed else None,
    )


def _field(path: Path, where: Any, name: str) -> Any:
    if not isinstance(where, dict) or name not in where:
        raise InputError(f"{path}: a ping has no {name}; expected a struct with it")
    return where[name]


def _recording(
    path: Path, *, responses: list[Any], sensors: list[Any], rate: float, speed: float | None
) -> Recording:
    if not responses:
        raise InputError(f"{path}: holds no pings")
    position = np.stack([vector(path, sensor, "position", 3) for sensor in sensors])
    turns = np.radians(np.stack([vector(path, one, "orientation", 3) for one in sensors]))
    receivers = np.asarray(_field(path, sensors[0], "coordsReceivers"), dtype=np.float64)
    receivers = receivers.reshape(-1, receivers.shape[-1] if receivers.ndim else 1)
    if receivers.shape[1:] != (3,):
        raise InputError(f"{path}: coordsReceivers has shape {receivers.shape}, expected (E, 3)")
    emitter = vector(path, sensors[0], "coordsEmitter", 3)
    shapes = {np.shape(one) for one in responses}
    if len(shapes) > 1 or len(next(iter(shapes))) != 2:
        listed = ", ".join(map(str, sorted(shapes)[:3]))
        raise InputError(f"{path}: impulseResponse has shapes {listed}, expected one (S, E)")
    if next(iter(shapes))[1] != len(receivers):
        raise InputError(
            f"{path}: impulseResponse has {next(iter(shapes))[1]} channels, coordsReceivers "
            f"{len(receivers)} places"
        )
    roll, pitch, yaw = turns.T
    values = dict(zip(("x", "y", "z"), position.T, strict=True))
    columns = Columns(
        str(path),
        {**values, "yaw": yaw, "pitch": pitch, "roll": roll},
        {},
        None,
        {"x": "m", "yaw": "deg"},
    )
    read: Callable[[int], NDArray[Any]] = lambda index: responses[index].T  # noqa: E731
    heard: dict[str, dict[str, Any]] = {
        "ears": {
            "receivers": receivers.tolist(),
            "emitter": emitter.tolist(),
            "directivity": "omnidirectional",
            "beam_radius": 0.0,
        }
    }
    if speed is not None:
        heard["air"] = {"speed_of_sound": speed}
    return Recording(
        path=path,
        sampling_rate=rate,
        labels=tuple(f"ping {index}" for index in range(len(responses))),
        emission=np.zeros(len(responses)),
        read=read,
        columns=columns,
        settings=heard,
    )
