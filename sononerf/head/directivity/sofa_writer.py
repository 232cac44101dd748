# SPDX-License-Identifier: MIT
"""Writing a directivity as a SOFA file that other programs read."""

from __future__ import annotations

import datetime
import io
from pathlib import Path
from typing import Any

import h5py
import numpy as np
from numpy.typing import NDArray

from sononerf import __version__, storage
from sononerf.head.directivity.record import Directivity
from sononerf.head.directivity.sofa import EMITTER
from sononerf.head.ears import Ears

NO_VARIABLE = "This is a netCDF dimension but not a netCDF variable.%10d"
"""What netCDF, on which SOFA rests, writes as the name of a mere dimension."""


def directivity_of(ears: Ears, *, source: str = "settings") -> Directivity:
    """Return the tables of a head as a directivity, both ends of the azimuth axis once.

    Parameters
    ----------
    ears : Ears
        At the frequencies that are wanted.
    source : str
        Its name in messages.
    """
    directions = ears.directions[:, :-1].reshape(-1, 3)

    def rows(table: NDArray[np.float32]) -> NDArray[np.float64]:
        part = table[..., :-1].astype(np.float64)
        return np.moveaxis(part.reshape(*part.shape[:-2], -1), -1, -2)

    return Directivity(
        source, directions, ears.frequency, rows(ears.ears), rows(ears.beam), ears.positions
    )


def write_sofa(path: Path, directivity: Directivity, *, title: str = "directivity") -> None:
    """Write a directivity as SOFA ``GeneralTF`` 2.0.

    The emitter's gain, if there is one, is a last receiver with the description ``emitter``.
    Gains are written as real parts.

    Parameters
    ----------
    path : Path
        The file.
    directivity : Directivity
        What is written.
    title : str
        Of the file.
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
