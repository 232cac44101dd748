# SPDX-License-Identifier: MIT
"""Directivities in files: SOFA, the `.mat` files of two laboratories, tables of text.

A SOFA file is read and written by the package `sofar` (``pip install 'sononerf[sofa]'``). Of
``SimpleFreeFieldHRIR``, ``SimpleFreeFieldHRTF`` and ``GeneralTF`` each measurement is a direction.
``FreeFieldDirectivityTF`` is one transducer, measured as a source by receivers in all directions;
it is taken to hear as it sends. Phases and delays are left out. Of MATLAB's files:

============  =================================================================================
struct        fields
============  =================================================================================
array_struct  SonoNERF: ``freq_vec``, ``az_grid_vec``, ``el_grid_vec`` (degrees), and in
              ``left_struct`` and ``right_struct`` each ``hrtf_gridded_array`` (el, az, freq)
bat_hrtf      BatSLAM2: ``freq_vec``, ``az_vec``, ``el_vec`` (degrees), ``hrtf_left``,
              ``hrtf_right`` and perhaps ``hrtf_em``, the emission (az, el, freq)
============  =================================================================================
"""

from __future__ import annotations

import hashlib
import io
import logging
import math
import tempfile
import warnings
from functools import lru_cache
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from sononerf import storage
from sononerf.errors import InputError
from sononerf.head.directivity import FADE, MOST_RECEIVERS, Directivity, unit_vectors
from sononerf.matlab_files import read_mat
from sononerf.numerics import Floats
from sononerf.storage import name_by_content, require_regular, wrong_kind

logger = logging.getLogger("sononerf")

MOST_BYTES = 2_000_000_000
HDF5_SIGNATURE = b"\x89HDF\r\n\x1a\n"
SIDES = ("left", "right")
CONVENTIONS = ("SimpleFreeFieldHRIR", "SimpleFreeFieldHRTF", "GeneralTF", "FreeFieldDirectivityTF")
METRES = ("", "m", "metre", "meter", "metres", "meters")
HERTZ = {"": 1.0, "hz": 1.0, "hertz": 1.0, "khz": 1e3, "kilohertz": 1e3}
"""Units of frequencies and sampling rates, Hz."""
EMITTER = "emitter"
"""Name of the receiver that holds the gain of the emitter."""
EMITTER_ATTRIBUTE = "GLOBAL_LastReceiver"
"""Attribute of SOFA files of sononerf whose last receiver is the emitter, as sofar names it."""


def read_directivity(path: Path) -> Directivity:
    """Read a SOFA file, a `.mat` file or a table of text; kept until the file changes."""
    return _read(path, content_hash(path))


def content_hash(path: Path) -> str:
    """Return the SHA-256 of a file."""
    try:
        require_regular(path)
        with path.open("rb") as file:
            return hashlib.file_digest(file, "sha256").hexdigest()
    except FileNotFoundError:
        raise InputError(f"{path}: no such file") from None
    except OSError as error:
        raise InputError(f"{path}: cannot be read ({error.strerror})") from None


@lru_cache(maxsize=4)
def _read(path: Path, content: str) -> Directivity:
    del content  # a changed file is read again
    if path.stat().st_size > MOST_BYTES:
        raise InputError(f"{path}: larger than {MOST_BYTES} bytes")
    with path.open("rb") as file:
        start = file.read(8)
    if start == HDF5_SIGNATURE:
        directivity = read_sofa(path)
    # MATLAB's version 7.3 is HDF5 behind such a text.
    elif start.startswith(b"MATLAB "):
        directivity = read_matlab(path)
    else:
        directivity = read_csv(path)
    if directivity.is_flat:
        logger.warning(
            "%s: the directivity is measured in one plane alone; beside it gains fade to zero, so "
            "echoes from there count as silent; measure other elevations too, or set "
            "ears.directivity=omnidirectional",
            path,
        )
    middle = directivity.directions.mean(axis=0)
    if (directivity.directions @ middle).min() > math.cos(FADE) * float(np.linalg.norm(middle)):
        logger.warning(
            "%s: the directivity is measured within %.0f degrees of one direction alone; beside "
            "it gains fade to zero; are the angles radians?",
            *(path, math.degrees(FADE)),
        )
    return directivity


def read_csv(path: Path) -> Directivity:
    """Read a table of gains.

    Columns ``azimuth_deg`` (to the left), ``elevation_deg`` (up), ``frequency_hz``, ``gain``
    (linear) or ``gain_db``, and perhaps ``receiver``: a number from 0 on, or ``emitter``. Every
    receiver has every direction at every frequency, once, in any order.
    """
    if name_by_content(path):
        raise wrong_kind(path, "SOFA file, .mat file or table of gains")
    try:
        text = path.read_text(encoding="utf-8-sig")
    except UnicodeDecodeError as error:
        raise InputError(
            f"{path}: no SOFA file, no .mat file and no table of text ({error})"
        ) from None
    head, _, rest = text.partition("\n")
    names = [name.strip().lower() for name in head.split(",") if name.strip()]
    gain = [name for name in ("gain", "gain_db") if name in names]
    if not {"azimuth_deg", "elevation_deg", "frequency_hz"} <= set(names) or len(gain) != 1:
        raise InputError(
            f"{path}: columns {', '.join(names)[:200] or 'none'}; expected azimuth_deg, "
            "elevation_deg, frequency_hz, one of gain and gain_db, and perhaps receiver"
        )
    if not rest.strip():
        raise InputError(f"{path}: holds no gains")
    kind = [(name, "U12" if name == "receiver" else "f8") for name in names]
    try:
        rows = np.loadtxt(io.StringIO(rest), dtype=kind, delimiter=",", comments=None, ndmin=1)
    except ValueError as error:
        said = str(error).partition("; use")[0].replace("the dtype passed requires ", "")
        raise InputError(f"{path}: {said} (row 0 is the first of the data)") from None
    receiver = np.char.strip(rows["receiver"]) if "receiver" in names else np.full(len(rows), "0")
    angles = np.stack([rows["azimuth_deg"], rows["elevation_deg"]], axis=1)
    values = np.column_stack([angles, rows["frequency_hz"], rows[gain[0]]])
    wrong = ~np.isfinite(values).all(axis=1) | (np.abs(angles[:, 1]) > 90.0)
    if wrong.any():
        raise InputError(
            f"{path}: data line {wrong.argmax() + 1}: a value is NaN or infinite, or an elevation "
            "is beyond 90 degrees"
        )
    gains = 10.0 ** (values[:, 3].clip(max=200.0) / 20.0) if gain[0] == "gain_db" else values[:, 3]
    # Angles count to a millionth of a degree.
    directions, of_direction = np.unique(angles.round(6), axis=0, return_inverse=True)
    frequency, of_frequency = np.unique(values[:, 2], return_inverse=True)
    ears = sorted(set(receiver.tolist()) - {EMITTER}, key=lambda name: (len(name), name))
    if not ears or ears != [str(number) for number in range(min(len(ears), MOST_RECEIVERS))]:
        raise InputError(
            f"{path}: the receivers are {', '.join(ears)[:200] or 'none'}; expected 0, 1, ... "
            "without a gap, and perhaps emitter"
        )
    tables = {}
    for name in sorted(set(receiver.tolist())):
        own = receiver == name
        cell = of_direction.reshape(-1)[own] * len(frequency) + of_frequency[own]
        times = np.bincount(cell, minlength=len(directions) * len(frequency))
        if (times != 1).any():
            first = int((times != 1).argmax())
            azimuth, elevation = directions[first // len(frequency)]
            raise InputError(
                f"{path}: receiver {name} has {times[first]} gains at azimuth {azimuth:g}, "
                f"elevation {elevation:g}, {frequency[first % len(frequency)]:g} Hz, expected one"
            )
        tables[name] = gains[own][np.argsort(cell)].reshape(len(directions), len(frequency))
    beam = tables.pop(EMITTER, None)
    vectors = unit_vectors(*np.radians(directions).T)
    return Directivity(str(path), vectors, frequency, np.stack([tables[n] for n in ears]), beam)


def read_matlab(path: Path) -> Directivity:
    """Read a struct of one of the two laboratories from a `.mat` file of version 5 or 7.3."""
    structs = read_mat(path, ("array_struct", "bat_hrtf"))
    if not structs:
        raise InputError(f"{path}: holds neither the struct array_struct nor bat_hrtf")
    name, struct = next(iter(structs.items()))

    def array(field: str, *, needed: bool = True) -> NDArray[Any] | None:
        node: Any = struct
        for part in field.split("."):
            node = node.get(part) if isinstance(node, dict) else None
        if node is None and not needed:
            return None
        if not isinstance(node, np.ndarray):
            raise InputError(f"{path}: {name}.{field} is missing, or no array of numbers")
        return node

    grid = name == "array_struct"
    fields = ("freq_vec", *(("az_grid_vec", "el_grid_vec") if grid else ("az_vec", "el_vec")))
    vectors = [np.asarray(array(field), dtype=np.float64).reshape(-1) for field in fields]
    frequency, azimuth, elevation = vectors
    if not np.isfinite(azimuth).all() or not np.isfinite(elevation).all():
        raise InputError(f"{path}: an azimuth or elevation is NaN or infinite")
    if np.abs(elevation).max(initial=0.0) > 90.0 or np.abs(azimuth).max(initial=0.0) > 360.0:
        raise InputError(f"{path}: an angle is beyond 90 or 360 degrees; expected degrees")
    sizes = (len(azimuth), len(elevation))
    shape = (*(sizes[::-1] if grid else sizes), len(frequency))

    def gains(field: str, values: NDArray[Any] | None) -> Floats:
        assert values is not None
        if [size for size in values.shape if size > 1] != [size for size in shape if size > 1]:
            order = "elevation, azimuth" if grid else "azimuth, elevation"
            raise InputError(
                f"{path}: {name}.{field} has the shape {values.shape}, expected {shape} ({order}, "
                "frequency)"
            )
        table = values.reshape(shape)
        table = table.transpose(1, 0, 2) if grid else table
        real = np.abs(table) if np.iscomplexobj(table) else table
        return np.asarray(real, dtype=np.float64).reshape(-1, len(frequency))

    sides = [f"{side}_struct.hrtf_gridded_array" if grid else f"hrtf_{side}" for side in SIDES]
    emitted = None if grid else array("hrtf_em", needed=False)
    angles = np.radians(np.meshgrid(azimuth, elevation, indexing="ij"))
    return Directivity(
        source=str(path),
        directions=unit_vectors(*angles).reshape(-1, 3),
        frequency=frequency,
        gains=np.stack([gains(field, array(field)) for field in sides]),
        beam=None if emitted is None else gains("hrtf_em", emitted),
    )


def _sofar() -> Any:
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")  # of what it imports itself
            import sofar
    except ImportError:
        raise InputError(
            "SOFA files need the package sofar: pip install 'sononerf[sofa]'"
        ) from None
    return sofar


def read_sofa(path: Path) -> Directivity:
    """Read a SOFA file, leniently: what is odd is logged, what is missing has its default."""
    sofar = _sofar()
    with tempfile.TemporaryDirectory() as folder:
        named = path.absolute()
        if path.suffix != ".sofa":  # it reads no other name
            named = Path(folder) / "directivity.sofa"
            named.symlink_to(path.absolute())
        try:
            file = sofar.read_sofa(str(named), verify=False, verbose=False)
        except Exception as error:  # the error of a damaged file depends on the reader
            said = " ".join(str(error).split())
            raise InputError(f"{path}: damaged or truncated, or no SOFA file ({said})") from None
    return _Sofa(path, file).directivity()


class _Sofa:
    """A SOFA file as an object of sofar."""

    def __init__(self, path: Path, file: Any) -> None:
        self.path, self.file = path, file

    def directivity(self) -> Directivity:
        convention = str(getattr(self.file, "GLOBAL_SOFAConventions", ""))
        if convention not in CONVENTIONS:
            raise InputError(
                f"{self.path}: SOFA convention {convention!r}, expected {', '.join(CONVENTIONS)}"
            )
        frequency, gains = self._spectrum()
        if convention == CONVENTIONS[-1]:
            return self._transducer(frequency, gains)
        measurements, receivers = gains.shape[:2]
        source = self._position("SourcePosition", measurements)
        offsets = source - self._position("ListenerPosition", measurements, [[0.0, 0.0, 0.0]])
        directions = np.einsum("mij,mj->mi", self._frame("Listener", measurements), offsets)
        self._require_one_distance(offsets)
        places = self._position("ReceiverPosition", receivers, [[0.0, 0.0, 0.0]])
        last = str(getattr(self.file, EMITTER_ATTRIBUTE, "")) == EMITTER
        emitting = [receivers - 1] if last else []
        hearing = [number for number in range(receivers) if number not in emitting]
        apart = len(hearing) < 2 or np.ptp(places[hearing], axis=0).any()
        return Directivity(
            source=str(self.path),
            directions=self._units(directions),
            frequency=frequency,
            gains=gains[:, hearing].transpose(1, 0, 2),
            beam=gains[:, emitting[0]] if emitting else None,
            places=places[hearing] if apart else None,  # all at one point: it does not say where
        )

    def _require_one_distance(self, offsets: Floats) -> None:
        """Refuse directions that were measured at several distances, whose gains differ."""
        distance = np.linalg.norm(offsets, axis=1)
        _, index = np.unique(self._units(offsets).round(6), axis=0, return_inverse=True)
        order = np.lexsort((distance, index.reshape(-1)))
        same = np.diff(index.reshape(-1)[order]) == 0
        apart = np.diff(distance[order]) > 0.01 * distance[order][1:]
        if (same & apart).any():
            raise InputError(
                f"{self.path}: directions are measured at several distances, from "
                f"{distance.min():.3g} to {distance.max():.3g}; keep those of one"
            )

    def _transducer(self, frequency: Floats, gains: Floats) -> Directivity:
        if len(gains) != 1:
            raise InputError(
                f"{self.path}: holds {len(gains)} measurements of a transducer, expected 1"
            )
        receivers = self._position("ReceiverPosition", gains.shape[1])
        source = self._position("SourcePosition", 1, [[0.0, 0.0, 0.0]])
        listener = self._position("ListenerPosition", 1, [[0.0, 0.0, 0.0]])
        offsets = receivers @ self._frame("Listener", 1)[0] + listener - source
        directions = self._units(offsets @ self._frame("Source", 1)[0].T)
        return Directivity(str(self.path), directions, frequency, gains, beam=gains[0])

    def _numbers(self, name: str, otherwise: Any = None) -> NDArray[Any]:
        values = getattr(self.file, name, otherwise)
        array = (
            np.ma.filled(np.ma.asarray(values, dtype=np.float64), np.nan)
            if (values is not None)
            else np.zeros(0)
        )
        if not array.size:
            raise InputError(f"{self.path}: holds no {name.replace('_', '.')}")
        return array

    def _spectrum(self) -> tuple[Floats, Floats]:
        """Return frequencies (F,) and magnitudes (M, R, F)."""
        if hasattr(self.file, "Data_IR"):
            response = self._whole("Data_IR")
            rate = float(self._hertz("Data_SamplingRate")[0])
            if not 0.0 < rate < 1e9:
                raise InputError(f"{self.path}: Data.SamplingRate is {rate:g} Hz, expected above 0")
            # Twice as long: a squared magnitude changes twice as fast as its response is long.
            length = 2 * response.shape[2]
            return (
                np.arange(length // 2 + 1) * (rate / length),
                np.abs(np.fft.rfft(response, length, axis=2)),
            )
        real, frequency = self._whole("Data_Real"), self._hertz("N")
        if hasattr(self.file, "Data_Imag"):
            imaginary = self._whole("Data_Imag")
            if real.shape != imaginary.shape:
                raise InputError(
                    f"{self.path}: Data.Real and Data.Imag differ in shape: {real.shape}, "
                    f"{imaginary.shape}"
                )
            real = np.hypot(real, imaginary)
        if real.shape[2] != len(frequency):
            raise InputError(
                f"{self.path}: the data have the shape {real.shape}, expected (measurements, "
                f"receivers, {len(frequency)} frequencies)"
            )
        return frequency, np.abs(real)

    def _hertz(self, name: str) -> Floats:
        """Return frequencies or sampling rates (N,) in Hz."""
        unit = str(getattr(self.file, f"{name}_Units", "")).partition(",")[0].strip().lower()
        if unit not in HERTZ:
            raise InputError(
                f"{self.path}: {name.replace('_', '.')} is in {unit}, expected hertz or kilohertz"
            )
        return self._numbers(name).reshape(-1) * HERTZ[unit]

    def _whole(self, name: str) -> Floats:
        """Return data (M, R, N or F); sofar leaves trailing dimensions of one out."""
        values = self._numbers(name)
        return values.reshape(*values.shape, *[1] * (3 - values.ndim))

    def _position(self, name: str, rows: int, otherwise: Any = None) -> Floats:
        """Return a position or direction (rows, 3) in metres; one row stands for all."""
        values = np.atleast_2d(np.squeeze(self._numbers(name, otherwise)))
        if values.shape not in ((1, 3), (rows, 3)):
            raise InputError(
                f"{self.path}: {name} has the shape {values.shape}, expected ({rows}, 3)"
            )
        # Up has the type and the units of View.
        owner = name.replace("Up", "View")
        kind = str(getattr(self.file, f"{owner}_Type", "cartesian")).strip().lower()
        unit = str(getattr(self.file, f"{owner}_Units", "")).partition(",")[0].strip().lower()
        if kind == "spherical":
            angles = values[:, :2] if unit.startswith("rad") else np.radians(values[:, :2])
            if np.abs(angles[:, 1]).max() > math.pi / 2.0 + 1e-3:
                raise InputError(
                    f"{self.path}: {name} has an elevation of "
                    f"{math.degrees(np.abs(angles[:, 1]).max()):.4g} degrees, expected -90 to 90"
                )
            if unit.startswith("rad"):
                logger.warning("%s: %s is in radians, and is read so", self.path, name)
            values = values[:, 2:] * unit_vectors(*angles.T)
        elif kind != "cartesian":
            raise InputError(f"{self.path}: {name} is {kind}, expected spherical or cartesian")
        elif unit not in METRES:
            raise InputError(f"{self.path}: {name} is in {unit}, expected metre")
        return np.repeat(values, rows, axis=0) if len(values) == 1 else values

    def _frame(self, whose: str, rows: int) -> Floats:
        """Return matrices (rows, 3, 3) from the world to where a listener or source looks."""
        if not hasattr(self.file, f"{whose}View") or not hasattr(self.file, f"{whose}Up"):
            return np.tile(np.eye(3), (rows, 1, 1))
        view = self._units(self._position(f"{whose}View", rows))
        side = self._units(np.cross(self._position(f"{whose}Up", rows), view))
        return np.stack([view, side, np.cross(view, side)], axis=1)

    def _units(self, vectors: Floats) -> Floats:
        length = np.linalg.norm(vectors, axis=-1, keepdims=True)
        if not np.isfinite(vectors).all() or not (length > 1e-9).all():
            raise InputError(
                f"{self.path}: a position or view gives no direction (zero, NaN or infinite)"
            )
        return np.asarray(vectors / length)


def write_sofa(path: Path, directivity: Directivity, *, title: str = "directivity") -> None:
    """Write a directivity as SOFA ``GeneralTF`` 2.0.

    The emitter's gain, if there is one, is that of a last receiver, and the
    global attribute ``LastReceiver`` says so.
    Gains are written as real parts.
    """
    gains, places = directivity.gains, directivity.places
    places = np.zeros((len(gains), 3)) if places is None else places
    if directivity.beam is not None:
        gains = np.concatenate([gains, directivity.beam[None]])
        places = np.concatenate([places, np.zeros((1, 3))])
    x, y, z = directivity.directions.T
    azimuth = np.degrees(np.arctan2(y, x)) % 360.0
    elevation = np.degrees(np.arctan2(z, np.hypot(x, y)))
    sofar = _sofar()
    file = sofar.Sofa("GeneralTF", version="2.0")
    file.GLOBAL_Title = title
    file.ReceiverPosition = places
    if directivity.beam is not None:
        file.add_attribute(EMITTER_ATTRIBUTE, EMITTER)
    file.SourcePosition = np.stack([azimuth, elevation, np.ones_like(azimuth)], axis=1)
    file.N, file.Data_Real = directivity.frequency, gains.transpose(1, 0, 2)
    file.Data_Imag = np.zeros(file.Data_Real.shape)
    with tempfile.TemporaryDirectory() as folder:
        made = Path(folder) / "made.sofa"
        sofar.write_sofa(str(made), file)
        storage.commit_bytes(path, made.read_bytes())
