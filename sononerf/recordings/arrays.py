# SPDX-License-Identifier: MIT
"""Format ``numpy``: arrays by name in an ``.npz`` or in the root of an HDF5 file.

====================  =============  ===============================================================
array                 shape          what it is
====================  =============  ===============================================================
waveform              (P, E, S)      samples; (P, S) of one receiver
sampling_rate         ()             Hz
start                 () or (P,)     s from the emission to sample 0, fractions of a sample
                                     included; 0 where left out
position              (P, 3)         x, y, z; with a unit, ``position_mm``
rotation              (P, 3, 3)      head to world, or
euler                 (P, 3)         yaw, pitch, roll; with a unit, ``euler_deg``, or
quaternion            (P, 4)         in the order that ``import.quaternion`` states
angle, height         (P,)           of a turntable
split                 (P,)           0 train, 1 validation, 2 test
====================  =============  ===============================================================
"""

from __future__ import annotations

from functools import lru_cache
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from sononerf import matlab_files as hdf5
from sononerf.echoes.layout import SPLITS
from sononerf.errors import InputError
from sononerf.recordings.audio import Recording
from sononerf.recordings.columns import EULER, PLACE, Columns, columns_of
from sononerf.settings.import_schema import ImportSettings

HDF5 = (".h5", ".hdf5", ".hdf")
SUFFIXES = (".npz", *HDF5)
SOUND = ("waveform", "sampling_rate", "start", "split")
WHOLE = {"position": PLACE, "euler": EULER}


def read_arrays(path: Path) -> dict[str, NDArray[Any]]:
    """Read all arrays of an ``.npz``, or of the root of an HDF5 file."""
    if not path.is_file():
        raise InputError(f"{path}: no such file")
    stamp = path.stat()
    return _read(path, stamp.st_mtime_ns, stamp.st_size)


@lru_cache(maxsize=2)  # one file holds many pings
def _read(path: Path, *stamp: int) -> dict[str, NDArray[Any]]:
    """Read a file as it was at a time and of a size."""
    del stamp
    if path.suffix.lower() in HDF5:
        with hdf5.opened(path) as file:
            found = {name: hdf5.numbers(file, name) for name in file}
        return {name: values for name, values in found.items() if values is not None}
    try:
        with path.open("rb") as file:
            found = np.load(file, allow_pickle=False)
            if isinstance(found, np.ndarray):
                raise InputError(f"{path}: one array only; save arrays by name with numpy.savez")
            arrays = {name: np.asarray(found[name]) for name in found.files}
    except InputError:
        raise
    except Exception as error:  # the error of a damaged file depends on the parser
        said = " ".join(str(error).split())
        raise InputError(f"{path}: damaged, truncated, or no .npz of numbers ({said})") from None
    odd = [name for name, values in arrays.items() if values.dtype.kind not in "biuf"]
    if odd:
        raise InputError(f"{path}: {odd[0]} holds {arrays[odd[0]].dtype}, expected numbers")
    return arrays


def waveform_of(
    path: Path, arrays: dict[str, NDArray[Any]], settings: ImportSettings
) -> tuple[float, NDArray[Any]]:
    """Return the sampling rate (Hz) and the unchanged array ``waveform``."""
    if "waveform" not in arrays:
        listed = ", ".join(sorted(arrays)) or "nothing"
        raise InputError(f"{path}: holds no array waveform; it holds {listed}")
    rate = arrays.get("sampling_rate")
    if rate is None and settings.sampling_rate is None:
        raise InputError(f"{path}: holds no sampling_rate; add it, or set import.sampling_rate")
    if rate is not None and (rate.size != 1 or not float(rate.reshape(-1)[0]) > 0.0):
        raise InputError(f"{path}: sampling_rate is {rate}, expected one number above 0")
    chosen = settings.sampling_rate if rate is None else float(rate.reshape(-1)[0])
    assert chosen is not None
    return chosen, arrays["waveform"]


def read_numpy(path: Path, settings: ImportSettings) -> Recording:
    """Read the format ``numpy``; see the module."""
    arrays = read_arrays(path)
    rate, waveform = waveform_of(path, arrays, settings)
    if waveform.ndim == 2:
        waveform = waveform[:, None]
    if waveform.ndim != 3 or not waveform.size:
        raise InputError(
            f"{path}: waveform has shape {waveform.shape}, expected (pings, receivers, samples)"
        )
    columns = _columns(path, arrays, settings)
    count = len(waveform)
    if len(columns) != count:
        raise InputError(f"{path}: {count} pings and {len(columns)} poses")
    start = np.asarray(arrays.get("start", 0.0), dtype=np.float64).reshape(-1)
    if len(start) not in (1, count) or not np.isfinite(start).all():
        raise InputError(f"{path}: start has {len(start)} values, expected 1 or {count} numbers")

    def read(index: int) -> NDArray[Any]:
        return waveform[index]

    return Recording(
        path=path,
        sampling_rate=rate,
        labels=tuple(f"ping {index}" for index in range(count)),
        emission=np.broadcast_to(-start, count).copy(),
        read=read,
        columns=columns,
    )


def _columns(path: Path, arrays: dict[str, NDArray[Any]], settings: ImportSettings) -> Columns:
    """Return the poses among arrays, one name per column."""
    given: dict[str, Any] = {}
    rotation = None
    sizes = {}
    for name, values in arrays.items():
        if name in SOUND:
            continue
        base, _, unit = name.partition("_")
        if name == "rotation":
            _shaped(path, name, values, (3, 3))
            rotation = values
        elif base in WHOLE:
            _shaped(path, name, values, (3,))
            suffix = f"_{unit}" if unit else ""
            given |= {f"{part}{suffix}": values[:, i] for i, part in enumerate(WHOLE[base])}
        elif name == "quaternion":
            _shaped(path, name, values, (4,))
            if settings.quaternion is None:
                raise InputError(
                    f"{path}: quaternion: set import.quaternion to its order, wxyz or xyzw"
                )
            given |= {f"q{part}": values[:, i] for i, part in enumerate(settings.quaternion)}
        else:
            _shaped(path, name, values, ())
            given[name] = values
        sizes[name] = len(values)
    if len(set(sizes.values())) > 1:
        listed = ", ".join(f"{name} {size}" for name, size in sizes.items())
        raise InputError(f"{path}: arrays of poses differ in length: {listed}")
    texts = {}
    if "split" in arrays:
        words = {number: word for word, number in SPLITS.items()}
        texts["split"] = [words.get(int(i), str(i)) for i in arrays["split"].reshape(-1)]
    return columns_of(str(path), given, settings, texts=texts, rotation=rotation)


def _shaped(path: Path, name: str, values: NDArray[Any], rest: tuple[int, ...]) -> None:
    if values.ndim != 1 + len(rest) or values.shape[1:] != rest:
        expected = ", ".join(["pings", *map(str, rest)])
        raise InputError(f"{path}: {name} has shape {values.shape}, expected ({expected})")
    if not np.isfinite(values).all():
        raise InputError(f"{path}: {name} holds values that are not finite")
