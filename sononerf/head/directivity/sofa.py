# SPDX-License-Identifier: MIT
"""Directivities as SOFA files, the standard AES69 [1]_: HDF5 with agreed names.

References:
    .. [1] AES69-2022, "AES standard for file exchange - Spatial acoustic data file format".
"""

from __future__ import annotations

import datetime
import io
from pathlib import Path
from typing import Any

import h5py
import numpy as np
from numpy.typing import NDArray

from sononerf import __version__, storage
from sononerf.array_types import Floats, Singles
from sononerf.errors import InputError
from sononerf.head.directivity.mat_files import find, numbers, opened, text
from sononerf.head.directivity.record import Directivity, unit_vectors
from sononerf.head.ears import Ears

EARS = ("SimpleFreeFieldHRIR", "SimpleFreeFieldHRTF", "GeneralTF")
BEAM = "FreeFieldDirectivityTF"
EMITTER = "emitter"
"""Description of the receiver that holds the gain of the emitter in SOFA files of sononerf."""
METRES = ("", "m", "metre", "meter", "metres", "meters")
DEGREES = ("", "degree", "degrees", "deg")


def read_sofa(path: Path) -> Directivity:
    """Read a SOFA file.

    Of ``SimpleFreeFieldHRIR``, ``SimpleFreeFieldHRTF`` and ``GeneralTF`` each measurement is a
    direction. ``FreeFieldDirectivityTF`` is one transducer, measured as a source by receivers in
    all directions; it is taken to hear as it sends. Phases and delays are left out.

    Returns:
        directivity: In the listener's frame (of a transducer, the source's): its view is ahead.
    """
    with opened(path) as file:
        if text(file, "Conventions") != "SOFA":
            raise InputError(f"{path}: no SOFA file; its attribute Conventions is missing")
        convention = text(file, "SOFAConventions")
        if convention not in (*EARS, BEAM):
            raise InputError(
                f"{path}: SOFA convention {convention!r}, expected {', '.join(EARS)} or {BEAM}"
            )
        frequency, gains = _spectrum(file, path)
        if convention == BEAM:
            return _transducer(file, path, frequency, gains)
        return _receivers(file, path, frequency, gains)


def _spectrum(file: h5py.File, path: Path) -> tuple[Floats, Floats]:
    """Return frequencies (F,) and magnitudes (M, R, F)."""
    if find(file, "Data.IR") is None:
        real, imaginary = numbers(file, "Data.Real"), numbers(file, "Data.Imag")
        if real.shape != imaginary.shape:
            raise InputError(
                f"{path}: Data.Real and Data.Imag differ in shape: {real.shape}, {imaginary.shape}"
            )
        pressure = real + 1j * imaginary
        frequency: Floats = numbers(file, "N").astype(np.float64).reshape(-1)
    else:
        response = numbers(file, "Data.IR").astype(np.float64)
        rate = float(numbers(file, "Data.SamplingRate").reshape(-1)[0])
        if not 0.0 < rate < 1e9:
            raise InputError(f"{path}: Data.SamplingRate is {rate:g} Hz, expected more than 0")
        # Twice as long: a squared magnitude changes twice as fast as its response is long.
        length = 2 * max(response.shape[-1], 1)
        pressure = np.fft.rfft(response, length, axis=-1)
        frequency = np.arange(length // 2 + 1) * (rate / length)
    if pressure.ndim != 3 or pressure.shape[2] != len(frequency):
        raise InputError(
            f"{path}: the data have the shape {pressure.shape}, expected (measurements, "
            f"receivers, {len(frequency)} frequencies)"
        )
    return frequency, np.abs(pressure)


def _receivers(file: h5py.File, path: Path, frequency: Floats, gains: Floats) -> Directivity:
    measurements, receivers = gains.shape[:2]
    source = _position(file, "SourcePosition", path, rows=measurements)
    listener = _position(file, "ListenerPosition", path, rows=measurements)
    frame = _frame(file, "Listener", path, rows=measurements)
    directions = _units(np.einsum("mij,mj->mi", frame, source - listener), path)
    places: Floats | None = _position(file, "ReceiverPosition", path, rows=receivers)
    emitting = [n for n, name in enumerate(_names(file, receivers)) if name == EMITTER]
    hearing = [number for number in range(receivers) if number not in emitting]
    assert places is not None
    places = places[hearing]
    if len(places) > 1 and not np.ptp(places, axis=0).any():
        places = None  # all at one point: the file does not say where
    return Directivity(
        source=str(path),
        directions=directions,
        frequency=frequency,
        gains=gains[:, hearing].transpose(1, 0, 2),
        beam=gains[:, emitting[0]] if emitting else None,
        places=places,
    )


def _transducer(file: h5py.File, path: Path, frequency: Floats, gains: Floats) -> Directivity:
    if len(gains) != 1:
        raise InputError(f"{path}: holds {len(gains)} measurements of a transducer, expected 1")
    receivers = _position(file, "ReceiverPosition", path, rows=gains.shape[1])
    source = _position(file, "SourcePosition", path, rows=1)
    listener = _position(file, "ListenerPosition", path, rows=1)
    ways = receivers @ _frame(file, "Listener", path, rows=1)[0] + listener - source
    directions = _units(ways @ _frame(file, "Source", path, rows=1)[0].T, path)
    return Directivity(str(path), directions, frequency, gains, beam=gains[0])


def _position(file: h5py.File, name: str, path: Path, *, rows: int) -> Floats:
    """Return a position or direction (rows, 3) in metres; one row in the file stands for all."""
    values = numbers(file, name).astype(np.float64)
    if values.ndim == 3 and values.shape[2] == 1:
        values = values[:, :, 0]
    if values.ndim != 2 or values.shape[1] != 3 or len(values) not in (1, rows):
        raise InputError(f"{path}: {name} has the shape {values.shape}, expected ({rows}, 3)")
    # Up has the type and the units of View.
    owner = file[name.replace("Up", "View")] if name.endswith("Up") else file[name]
    kind = text(owner, "Type", "cartesian").strip().lower()
    unit = text(owner, "Units").partition(",")[0].strip().lower()
    if kind == "spherical" and unit in DEGREES:
        values = values[:, 2:] * unit_vectors(*np.radians(values[:, :2].T))
    elif kind != "cartesian" or unit not in METRES:
        raise InputError(
            f"{path}: {name} is {kind} in {unit or 'no unit'}, expected spherical in degree, "
            "degree, metre, or cartesian in metre"
        )
    return np.repeat(values, rows, axis=0) if len(values) == 1 else values


def _frame(file: h5py.File, whose: str, path: Path, *, rows: int) -> Floats:
    """Return matrices (rows, 3, 3) from the world to where a listener or source looks."""
    if find(file, f"{whose}View") is None or find(file, f"{whose}Up") is None:
        return np.tile(np.eye(3), (rows, 1, 1))
    view = _units(_position(file, f"{whose}View", path, rows=rows), path)
    up = _position(file, f"{whose}Up", path, rows=rows)
    side = _units(np.cross(up, view), path)
    return np.stack([view, side, np.cross(view, side)], axis=1)


def _units(vectors: Floats, path: Path) -> Floats:
    length = np.linalg.norm(vectors, axis=-1, keepdims=True)
    if not np.isfinite(vectors).all() or not (length > 1e-9).all():
        raise InputError(f"{path}: a position or view gives no direction (zero, NaN or infinite)")
    return np.asarray(vectors / length)


def _names(file: h5py.File, receivers: int) -> list[str]:
    """Return the descriptions of the receivers, lower case; empty where there are none."""
    array = find(file, "ReceiverDescriptions")
    if not isinstance(array, h5py.Dataset) or array.dtype.kind != "S" or array.size > 100_000:
        return []
    values = np.asarray(array[()])
    if len(values) != receivers:
        return []
    rows = values.reshape(receivers, -1)
    return [b"".join(row.tolist()).decode("utf-8", "replace").strip().lower() for row in rows]


NO_VARIABLE = "This is a netCDF dimension but not a netCDF variable.%10d"
"""Name that netCDF, on which SOFA rests, gives to a dimension without a variable."""


def directivity_of(ears: Ears, *, source: str = "settings") -> Directivity:
    """Return the tables of a head as a directivity, both ends of the azimuth axis once."""
    directions = ears.directions[:, :-1].reshape(-1, 3)

    def rows(table: Singles) -> Floats:
        part = table[..., :-1].astype(np.float64)
        return np.moveaxis(part.reshape(*part.shape[:-2], -1), -1, -2)

    return Directivity(
        source, directions, ears.frequency, rows(ears.ears), rows(ears.beam), ears.positions
    )


def write_sofa(path: Path, directivity: Directivity, *, title: str = "directivity") -> None:
    """Write a directivity as SOFA ``GeneralTF`` 2.0.

    The emitter's gain, if there is one, is a last receiver with the description ``emitter``.
    Gains are written as real parts.
    """
    gains, places = directivity.gains, directivity.places
    names = [f"receiver {number}" for number in range(len(gains))]
    places = np.zeros((len(gains), 3)) if places is None else places
    if directivity.beam is not None:
        gains = np.concatenate([gains, directivity.beam[None]])
        places = np.concatenate([places, np.zeros((1, 3))])
        names.append(EMITTER)
    x, y, z = directivity.directions.T
    azimuth = np.degrees(np.arctan2(y, x)) % 360.0
    elevation = np.degrees(np.arctan2(z, np.hypot(x, y)))
    pressure = gains.transpose(1, 0, 2)
    letters = max(map(len, names))
    cartesian = {"Type": "cartesian", "Units": "metre"}
    variables: dict[str, tuple[str, NDArray[Any], dict[str, str]]] = {
        "ListenerPosition": ("IC", np.zeros((1, 3)), cartesian),
        "ReceiverPosition": ("RCI", places[:, :, None], cartesian),
        "SourcePosition": (
            "MC",
            np.stack([azimuth, elevation, np.ones_like(azimuth)], axis=1),
            {"Type": "spherical", "Units": "degree, degree, metre"},
        ),
        "EmitterPosition": ("ECI", np.zeros((1, 3, 1)), cartesian),
        "Data.Real": ("MRN", pressure, {}),
        "Data.Imag": ("MRN", np.zeros(pressure.shape), {}),
        "ReceiverDescriptions": (
            "RS",
            np.array([list(name.ljust(letters)) for name in names], dtype="S1"),
            {},
        ),
    }
    lengths = {"I": 1, "C": 3, "E": 1, "M": len(x), "R": len(gains), "S": letters}
    buffer = io.BytesIO()
    with h5py.File(buffer, "w") as file:
        for name, value in _head(title).items():
            file.attrs[name] = np.bytes_(value.encode() or b" ")
        for name, length in lengths.items():
            file.create_dataset(name, (length,), dtype=">f4").make_scale(NO_VARIABLE % length)
        axis = file.create_dataset("N", data=directivity.frequency)
        axis.make_scale("N")
        _describe(axis, {"LongName": "frequency", "Units": "hertz"})
        for name, (dimensions, values, attributes) in variables.items():
            variable = file.create_dataset(name, data=values)
            for number, dimension in enumerate(dimensions):
                variable.dims[number].attach_scale(file[dimension])
            _describe(variable, attributes)
    storage.commit_bytes(path, buffer.getbuffer())


def _describe(variable: Any, attributes: dict[str, str]) -> None:
    for name, value in attributes.items():
        variable.attrs[name] = np.bytes_(value.encode())


def _head(title: str) -> dict[str, str]:
    now = datetime.datetime.now(datetime.UTC).strftime("%Y-%m-%d %H:%M:%S")
    return {
        "Conventions": "SOFA",
        "Version": "2.1",
        "SOFAConventions": "GeneralTF",
        "SOFAConventionsVersion": "2.0",
        "APIName": "sononerf",
        "APIVersion": __version__,
        "ApplicationName": "sononerf",
        "ApplicationVersion": __version__,
        "AuthorContact": "",
        "Comment": "",
        "DataType": "TF",
        "History": "",
        "License": "No license provided, ask the author for permission",
        "Organization": "",
        "References": "",
        "RoomType": "free field",
        "Origin": "",
        "DateCreated": now,
        "DateModified": now,
        "Title": title,
    }
