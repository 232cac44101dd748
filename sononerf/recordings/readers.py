# SPDX-License-Identifier: MIT
"""Readers of recordings: folders of sounds with a table of poses, and files of other programs."""

from __future__ import annotations

import re
import unicodedata
from collections.abc import Callable, Collection
from functools import lru_cache
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from sononerf import matlab_files as hdf5
from sononerf.echoes.memory_ensemble import SPLITS
from sononerf.errors import InputError
from sononerf.matlab_files import as_list, read_mat, vector
from sononerf.numerics import Floats
from sononerf.recordings.pose_tables import EULER, PLACE, Columns, columns_of, read_table
from sononerf.recordings.recording import AUDIO, Recording, read_audio
from sononerf.settings.sections import ImportSettings
from sononerf.storage import wrong_kind

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
            arrays_read = {name: hdf5.numbers(file, name) for name in file}
        return {name: values for name, values in arrays_read.items() if values is not None}
    try:
        with path.open("rb") as file:
            start = file.read(6)
            if start[:2] != b"PK" and start != b"\x93NUMPY":
                raise wrong_kind(path, ".npz")
            file.seek(0)
            arrays_read = np.load(file, allow_pickle=False)
            if isinstance(arrays_read, np.ndarray):
                raise InputError(f"{path}: one array only; save arrays by name with numpy.savez")
            arrays = {name: np.asarray(arrays_read[name]) for name in arrays_read.files}
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
    content = read_mat(path, names)
    missing = [name for name in names[:2] if name not in content]
    if missing:
        raise InputError(f"{path}: holds no {missing[0]}; is it of the format sononerf-matlab?")
    sensors, results = (as_list(content[name]) for name in names[:2])
    if len(sensors) != len(results):
        raise InputError(f"{path}: {len(results)} pings and {len(sensors)} poses (structSensor)")
    said = as_list(content.get(names[2], {}))[0]
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
        yaw = np.full(len(places), ACROSS)
        values |= {"yaw": yaw, "pitch": 0.0 * yaw, "roll": 0.0 * yaw}
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


SOUNDS = (*AUDIO, *SUFFIXES)


def read_sound(path: Path, settings: ImportSettings) -> tuple[float, NDArray[Any]]:
    """Read one file of any kind: its sampling rate (Hz) and samples (E, S)."""
    suffix = path.suffix.lower()
    if suffix in AUDIO:
        wav = read_audio(path)
        if settings.sampling_rate is None and wav.true_rate is not None:
            raise InputError(
                f"{path}: its header states {wav.rate} Hz, its metadata (GUANO) a recorder of "
                f"{wav.true_rate} Hz, as after a time expansion; set import.sampling_rate="
                f"{wav.true_rate}, or {wav.rate} if the header is right"
            )
        return float(settings.sampling_rate or wav.rate), wav.samples.T
    if suffix not in SUFFIXES:
        raise InputError(f"{path}: unknown kind of file; known: {', '.join(SOUNDS)}")
    rate, samples = waveform_of(path, read_arrays(path), settings)
    samples = samples[None] if samples.ndim == 1 else samples
    if samples.ndim != 2 or not samples.size:
        raise InputError(
            f"{path}: waveform has shape {samples.shape}, expected (receivers, samples)"
        )
    return rate, samples


def read_folder(source: Path, settings: ImportSettings, apart: Collection[Path] = ()) -> Recording:
    """Read the format ``recordings``: sound files and a table of poses.

    One file per ping (column ``file``), or one long file (``import.file``, or the only one there)
    with the time of each emission in the column ``time``.
    """
    table = source if source.is_file() else source / settings.poses
    if not table.is_file():
        raise InputError(f"{table}: no table of poses; write one line per ping")
    folder = table.parent if source.is_file() else source
    columns = read_table(table, settings)
    apart = {(folder / path).resolve() for path in (*_others(settings), *apart)}
    files = _files(folder, columns, settings, apart)
    keep, further = _present(folder, files, columns, settings, apart)
    dropped = len(columns) - len(keep)
    columns = columns.take(keep)
    files = [files[row] for row in keep]
    rate, first = read_sound(files[0], settings)
    for path in dict.fromkeys(files):
        other, samples = read_sound(path, settings)
        if other != rate or len(samples) != len(first):
            raise InputError(
                f"{path}: {len(samples)} channels at {other:g} Hz, {files[0].name} has "
                f"{len(first)} at {rate:g} Hz; all must have the same"
            )
    times = columns.values.get("time")
    if times is None and len(set(files)) < len(files):
        twice = next(path for path in files if files.count(path) > 1)
        raise InputError(
            f"{table}: {files.count(twice)} pings in {twice.name} and no column time; add the time "
            "of each emission, s from the start of the file"
        )

    def read(index: int) -> NDArray[Any]:
        return read_sound(files[index], settings)[1]

    notes = [f"{dropped} poses without a recording are left out"] if dropped else []
    if further:
        listed = ", ".join(path.name for path in further[:3])
        notes.append(f"{listed}{' ...' if len(further) > 3 else ''}: no pings, as their names say")
    single = len(set(files)) == len(files) and len(files) > 1
    names = [
        path.name if single else f"{path.name}, row {row + 1}"
        for row, path in zip(keep, files, strict=True)
    ]
    return Recording(
        path=table,
        sampling_rate=rate,
        labels=tuple(names),
        emission=np.zeros(len(files)) if times is None else times,
        read=read,
        columns=columns,
        notes=tuple(notes),
        until=None if times is None else _next_call(table, files, times, keep),
    )


def _next_call(table: Path, files: list[Path], times: Floats, rows: list[int]) -> Floats:
    """Return the emission of the next call in the same file, (P,) s; infinite if none."""
    until = np.full(len(files), np.inf)
    for path in dict.fromkeys(files):
        inside = np.array([row for row, other in enumerate(files) if other == path])
        order = inside[np.argsort(times[inside], kind="stable")]
        apart = np.diff(times[order])
        if (apart == 0.0).any():
            first = int(np.flatnonzero(apart == 0.0)[0])
            one, other = sorted(rows[i] + 1 for i in order[first : first + 2])
            raise InputError(
                f"{table}: rows {one} and {other} have the same time of emission in {path.name}; "
                "each call has a time of its own"
            )
        until[order[:-1]] = times[order[1:]]
    return until


def _others(settings: ImportSettings) -> set[Path]:
    """Return the files of the settings that are no pings."""
    reference = [settings.reference.file] if settings.reference is not None else []
    return {path for path in (settings.background, *reference) if path is not None}


def _files(
    folder: Path, columns: Columns, settings: ImportSettings, apart: Collection[Path]
) -> list[Path]:
    """Return the file of each row."""
    if "file" in columns.texts:
        empty = [row for row, name in enumerate(columns.texts["file"]) if not name]
        if empty:
            raise InputError(f"{columns.where}: column file of row {empty[0] + 1} is empty")
        return [_spelled(folder, name) for name in columns.texts["file"]]
    if settings.file is not None:
        return [folder / settings.file] * len(columns)
    sounds = _sounds(folder, apart)
    if len(sounds) == 1:
        return sounds * len(columns)
    raise InputError(
        f"{columns.where}: no column file, and {len(sounds)} recordings in {folder}; name each "
        "ping's file in a column file, or the long one in import.file"
    )


def _spelled(folder: Path, name: str) -> Path:
    """Return the file of a name in the disk's own spelling of accents and slashes."""
    forms = [name, name.replace("\\", "/")]
    forms += [unicodedata.normalize(form, forms[1]) for form in ("NFC", "NFD")]
    return next((folder / form for form in forms if (folder / form).is_file()), folder / name)


def _sounds(folder: Path, apart: Collection[Path]) -> list[Path]:
    return [
        path
        for path in sorted(folder.iterdir())
        if path.suffix.lower() in SOUNDS and path.resolve() not in apart
    ]


def _listed(path: Path, folder: Path) -> str:
    return str(path.relative_to(folder)) if path.is_relative_to(folder) else str(path)


def _pattern(path: Path) -> str:
    """Return a file's name with a mark in place of its numbers: pings differ in these alone."""
    return re.sub(r"\d+", "#", path.name)


def _present(
    folder: Path,
    files: list[Path],
    columns: Columns,
    settings: ImportSettings,
    apart: Collection[Path],
) -> tuple[list[int], list[Path]]:
    """Return the rows whose file is there, and the recordings that are no pings.

    A row without a file is refused or skipped, as set. A recording without a row is refused if it
    is named like a ping.
    """
    keep = [row for row, path in enumerate(files) if path.is_file()]
    if settings.missing == "skip":
        if not keep:
            raise InputError(f"{columns.where}: none of its {len(files)} recordings is there")
        return keep, []
    way_out = "correct the table, or set import.missing=skip"
    lost = [path for path in dict.fromkeys(files) if not path.is_file()]
    if lost:
        near = [path.name for path in folder.iterdir()]
        own_name = re.split(r"[\\/]", lost[0].name)[-1].casefold()
        near = [name for name in near if name.casefold() == own_name]
        hint = f" ({near[0]} is in {folder})" if near else ""
        raise InputError(
            f"{columns.where}: {len(lost)} poses have no recording, such as "
            f"{_listed(lost[0], folder)}{hint}; {way_out}"
        )
    used = {path.resolve() for path in files}
    folders = {path.parent for path in files}
    rest = [p for place in folders for p in _sounds(place, apart) if p.resolve() not in used]
    patterns = {_pattern(path) for path in files}
    unused = [path for path in rest if _pattern(path) in patterns]
    if unused:
        raise InputError(
            f"{folder}: {len(unused)} recordings have no pose, such as {unused[0].name}; {way_out}"
        )
    return keep, rest
