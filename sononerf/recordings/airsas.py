# SPDX-License-Identifier: MIT
"""Format ``airsas``: HDF5 files of the in-air synthetic aperture sonar data set.

=================  =========  ======================================================================
dataset            shape      what it is
=================  =========  ======================================================================
/ch1/ts ...        (P, S)     samples of each microphone
/na/position       (P,)       along the track, x, m; or (P, 3): x, y, z
/na/temperature    (P,)       degrees Celsius
=================  =========  ======================================================================

The array moves along x and looks across it, to positive y. Sampling rate, call, places of speaker
and microphones and the delay of the electronics stand in files beside it and are given as
settings: ``import.sampling_rate``, ``call``, ``ears``, ``import.time_offset``.

References:
    .. [1] T. E. Blanford et al., "An in-air synthetic aperture sonar dataset of target scattering
       in environments of varying complexity", Scientific Data 11, 2024.
"""

from __future__ import annotations

import re
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from sononerf import matlab_files as hdf5
from sononerf.array_types import Floats
from sononerf.errors import InputError
from sononerf.recordings.audio import Recording
from sononerf.recordings.columns import PLACE, Columns
from sononerf.settings.import_schema import ImportSettings

ACROSS = np.pi / 2  # yaw of a head that looks to positive y, rad


def read_airsas(path: Path, settings: ImportSettings) -> Recording:
    """Read the format ``airsas``; see the module."""
    if settings.sampling_rate is None:
        raise InputError(
            f"{path}: the format does not say its sampling rate; set import.sampling_rate"
        )
    with hdf5.opened(path) as file:
        names = sorted(
            (name for name in file if re.fullmatch(r"ch\d+", name)), key=lambda name: int(name[2:])
        )
        series = {name: hdf5.numbers(file, f"{name}/ts") for name in names}
        position = hdf5.numbers(file, "na/position")
        temperature = hdf5.numbers(file, "na/temperature")
    channels = {name: values for name, values in series.items() if values is not None}
    if not channels:
        raise InputError(f"{path}: holds no /ch1/ts; no file of the format airsas")
    if position is None:
        raise InputError(f"{path}: holds no /na/position; no file of the format airsas")
    places = _places(path, np.asarray(position, dtype=np.float64))
    waveform = {name: _by_ping(path, name, ts, len(places)) for name, ts in channels.items()}
    if len({ts.shape for ts in waveform.values()}) > 1:
        raise InputError(f"{path}: channels differ in length")
    values = dict(zip(PLACE, places.T, strict=True))
    if settings.look_at is None and settings.turntable is None:
        turned = np.full(len(places), ACROSS)
        values |= {"yaw": turned, "pitch": 0.0 * turned, "roll": 0.0 * turned}
    air: dict[str, Any] = {}
    if temperature is not None and temperature.size and np.isfinite(temperature).all():
        air = {"air": {"temperature_c": round(float(np.mean(temperature)), 3)}}

    def read(index: int) -> NDArray[Any]:
        return np.stack([ts[index] for ts in waveform.values()])

    return Recording(
        path=path,
        sampling_rate=settings.sampling_rate,
        labels=tuple(f"ping {index}" for index in range(len(places))),
        emission=np.zeros(len(places)),
        read=read,
        columns=Columns(str(path), values, {}, None, {"x": "m"}),
        settings=air,
        notes=(f"channels {', '.join(waveform)}",),
    )


def _places(path: Path, position: Floats) -> Floats:
    if not np.isfinite(position).all():
        raise InputError(f"{path}: /na/position holds values that are not finite")
    if position.ndim == 2 and 3 in position.shape and position.size > 3:
        return position if position.shape[1] == 3 else position.T
    if position.size == max(position.shape, default=0):
        along = position.reshape(-1)
        return np.stack([along, 0.0 * along, 0.0 * along], axis=1)
    raise InputError(f"{path}: /na/position has shape {position.shape}, expected (P,) or (P, 3)")


def _by_ping(path: Path, name: str, ts: NDArray[Any], count: int) -> NDArray[Any]:
    """Return one channel's samples, (P, S): MATLAB and Python lay them out in two ways."""
    if ts.ndim == 2 and ts.shape[0] == count:
        return ts
    if ts.ndim == 2 and ts.shape[1] == count:
        return ts.T
    raise InputError(
        f"{path}: /{name}/ts has shape {ts.shape}, and there are {count} poses in /na/position"
    )
