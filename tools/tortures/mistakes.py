# SPDX-License-Identifier: MIT
"""Wrong units, conventions and sizes: each is refused, or a warning names the cause."""

from __future__ import annotations

import logging
import random
import re
import shutil
import tempfile
from collections.abc import Callable, Iterable
from pathlib import Path

import numpy as np

from sononerf.echoes.echoes import Echoes
from sononerf.errors import SonoNerfError
from sononerf.geometry.poses import Poses, euler_from_rotation
from sononerf.head.head import Head
from sononerf.recordings.audio import wav_bytes
from sononerf.run.import_recordings import check_before, describe
from sononerf.run.understand import understand
from tests.recordings import recorded
from tests.recordings.test_recording_faults import FAULTS, PINGS, WARNED
from tests.recordings.two_spheres import write_folder
from tools.tortures.harness import SIMULATE, TINY, Report, give, prepared

OF_RECORDINGS = (
    *("another rate", "time-expanded", "no unit", "NaN in the table", "no quaternion", "ms for s"),
    *("s for ms", "one time twice", "range beyond the end", "NaN", "short", "clipped"),
    *("silent channel", "doubled channel", "all silent", "unplugged channel", "faint channel"),
    *("flat directivity", "off by one", "shuffled", "north and east", "wrong frame"),
    *("millimetres for metres", "scalar last", "swapped channels", "wrong rate", "late"),
)
"""Mistakes of the tests of recordings that are of physics, units and conventions."""
OF_SETTINGS: dict[str, tuple[tuple[str, ...], str]] = {
    "frequencies in kHz": (
        ("spectrogram.frequency_min=10", "spectrogram.frequency_max=100"),
        r"wavelength .* exceeds range_max .*kHz",
    ),
    "beam radius in mm": (("ears.beam_radius=3",), r"beam_radius.*in mm\?"),
    "piston radius in mm": (
        ("ears.directivity=piston", "ears.piston_radius=3"),
        r"piston_radius.*in mm\?",
    ),
    "receivers in mm": (
        ("ears.receivers=[[0, 20, 0], [0, -20, 0]]", "ears.directivity=omnidirectional"),
        r"receivers.*in mm\?",
    ),
    "ears in mm": (("ears.left=[-10, 10, 5]",), r"ears\.left.*in mm\?"),
    "emitter in mm": (("ears.emitter=[0, 0, -10]",), r"emitter.*in mm\?"),
    "ranges in mm": (
        ("spectrogram.range_min=340", "spectrogram.range_max=450"),
        r"no pose received an echo|memory",
    ),
    "radius of poses in mm": (("poses.radius=400",), r"check poses\.radius"),
    "scene in mm": (("scene.options.radius=20",), r"radius|too large|inside the scene|m across"),
    "speed in km/s": (("air.speed_of_sound=0.343",), r"speed_of_sound.*100"),
    "temperature in K": (("air.temperature_c=293",), r"temperature_c.*50"),
    "humidity in percent": (("air.relative_humidity=50",), r"relative_humidity.*1"),
    "pressure in kPa": (("air.pressure_pa=101",), r"pressure_pa.*20000"),
    "pressure in hPa": (("air.pressure_pa=1013",), r"pressure_pa.*20000"),
    "sampling rate in kHz": (("spectrogram.sampling_rate=1000",), r"frequency_max.*sampling_rate"),
    "call in ms": (("call.kind=linear", "call.duration=2"), r"duration.*0\.1"),
    "sweep in kHz": (
        ("call.kind=linear", "call.frequency_start=80", "call.frequency_end=20"),
        r"nothing would be heard",
    ),
    "frequency above half the rate": (
        ("spectrogram.sampling_rate=150e3",),
        r"must not exceed half the sampling_rate",
    ),
    "harmonics above half the rate": (
        ("call.kind=linear", "spectrogram.sampling_rate=250e3", "call.harmonics=[1, 1, 1]"),
        r"harmonic 1 reaches|above half",
    ),
    "ranges exchanged": (
        ("spectrogram.range_min=0.45", "spectrogram.range_max=0.34"),
        r"range_min must lie below range_max",
    ),
    "angle in radians below the least": (("ears.width_deg=0.8",), r"width_deg.*5"),
    "elevation beyond the pole": (("ears.elevation_deg=120",), r"elevation_deg.*90"),
    "poses inside the body": (("scene.options.radius=0.41",), r"inside the scene's surface"),
    "poses below the support": (("support.point=[0, 0, -0.1]",), r"not above the support"),
    "poses all too far": (("poses.radius=1.2",), r"no pose received an echo"),
    "window that does not suit the call": (
        ("call.kind=linear", "call.duration=0.003", "spectrogram.window=16"),
        r"window",
    ),
    "wavelengths beyond what edges are resolved for": (
        ("spectrogram.frequency_max=400e3", "simulation.engine=rays"),
        r"resolves edges and shadows up to",
    ),
    "too many poses": (("poses.count=1000000000",), r"memory"),
    "negative number of poses": (("poses.count=-5",), r"poses\.count"),
    "dB for a magnitude": (("call.harmonics=[-6, 0]",), r"harmonics"),
}
RIGHT = Poses.looking_at(Poses.sphere(24, radius=0.4).positions)


def _table(positions: np.ndarray, angles: Iterable[np.ndarray]) -> str:
    rows = np.column_stack([positions, *angles])
    lines = ["x,y,z,yaw,pitch,roll", *(",".join(f"{v:.9g}" for v in row) for row in rows)]
    return "\n".join(lines) + "\n"


def _tables() -> dict[str, tuple[str, str]]:
    """Return mistakes in a table of poses: what is written, and what has to be said."""
    turns = euler_from_rotation(RIGHT.rotations)
    yaw, pitch, roll = (np.degrees(np.asarray(angle)) for angle in turns)
    places = RIGHT.positions
    return {
        "radians in a table": (_table(places, turns), "radians, and are read as degrees"),
        "yaw and pitch swapped": (_table(places, (pitch, yaw, roll)), "yaw and pitch are swapped"),
        "all poses look away": (
            _table(places, (yaw + 180.0, -pitch, roll)),
            "the poses look the other way",
        ),
        "sign of yaw": (_table(places, (-yaw, pitch, roll)), "sign of yaw"),
        "places in mm": (_table(1e3 * places, (yaw, pitch, roll)), "no pose received an echo"),
        "equal poses": (
            _table(np.tile(places[:1], (24, 1)), (yaw[:1].repeat(24), pitch[:1].repeat(24), roll)),
            "all 24 poses are at one place",
        ),
        "NaN in a table": (_table(places * [[np.nan, 1, 1]], (yaw, pitch, roll)), "finite|NaN|nan"),
    }


def _of_import(folder: Path) -> str:
    """Return all that an import says of recordings."""
    said: list[str] = []

    class Heard(logging.Handler):
        def emit(self, record: logging.LogRecord) -> None:
            said.append(record.getMessage())

    logger, handler = logging.getLogger("sononerf"), Heard()
    logger.addHandler(handler)
    before, logger.propagate = logger.propagate, False
    try:
        known = understand("recordings", folder, folder.parent / "store")
        said += [line for line in describe(known) if line.startswith("warning")]
        said.append(check_before(known).message)
    except SonoNerfError as error:
        said.append(str(error))
    finally:
        logger.removeHandler(handler)
        logger.propagate = before
    return "\n".join(said).strip()


COLUMNS = ("x_m", "y_m", "z_m", "yaw_deg", "pitch_deg", "roll_deg")


def _write_point(folder: Path, columns: Iterable[str], values: np.ndarray) -> None:
    """Write recordings of a point, with a table of poses."""
    waveforms = recorded.waveforms(noise=1e-4)
    names = [f"ping_{index:02d}.wav" for index in range(len(waveforms))]
    folder.mkdir()
    for name, waveform in zip(names, waveforms, strict=True):
        (folder / name).write_bytes(wav_bytes(waveform, recorded.RATE))
    lines = [",".join(["file", *columns])]
    for name, row in zip(names, values.tolist(), strict=True):
        lines.append(",".join([name, *map(repr, row)]))
    (folder / "poses.csv").write_text("\n".join(lines) + "\n")
    (folder / "import.yaml").write_text(
        f"ears: {recorded.EARS}\ncall: {recorded.CALL}\nair: {{speed_of_sound: {recorded.SPEED}}}\n"
        "import: {compress: true}\n"
    )


def _of_points() -> dict[str, tuple[tuple[str, ...], np.ndarray, str]]:
    """Return mistakes in the table of recordings: columns, values, and what has to be said."""
    places, turned = recorded.poses()
    turns = np.stack([np.asarray(angle) for angle in euler_from_rotation(turned)], axis=1)
    right = np.column_stack([places, np.degrees(turns)])
    other = "another convention of poses"

    def order(*columns: int) -> np.ndarray:
        return right[:, list(columns)]

    def sign(column: int) -> np.ndarray:
        changed = right.copy()
        changed[:, column] *= -1.0
        return changed

    radians = np.column_stack([places, turns])
    said_radians = ("x_m", "y_m", "z_m", "yaw_rad", "pitch_rad", "roll_rad")
    return {
        "recordings: radians said to be degrees": (COLUMNS, radians, f"{other}.*in radians"),
        "recordings: degrees said to be radians": (said_radians, right, f"{other}.*in degrees"),
        "recordings: yaw and pitch swapped": (COLUMNS, order(0, 1, 2, 4, 3, 5), other),
        "recordings: sign of pitch": (COLUMNS, sign(4), other),
        "recordings: sign of yaw": (COLUMNS, sign(3), other),
        "recordings: y and z swapped": (COLUMNS, order(0, 2, 1, 3, 4, 5), other),
        "recordings: x and y swapped": (COLUMNS, order(1, 0, 2, 3, 4, 5), other),
        "recordings: sign of x": (COLUMNS, sign(0), other),
        "recordings: lengths in mm": (COLUMNS, right * ([1e3] * 3 + [1] * 3), r"lengths in mm\?"),
        "recordings: mm that are m": (
            ("x_mm", "y_mm", "z_mm", *COLUMNS[3:]),
            right,
            r"lengths in m\?",
        ),
        "recordings: rows off by one": (COLUMNS, np.roll(right, 1, axis=0), "off by one"),
    }


def _of_objects() -> dict[str, tuple[Callable[[], object], str]]:
    turned, head = RIGHT.rotations, Head()
    shape = (24, len(head.receivers), len(head.range), len(head.frequency))
    return {
        "left-handed rotations": (
            lambda: Poses(RIGHT.positions, turned @ np.diag([1.0, -1.0, 1.0])),
            "are no rotations",
        ),
        "scaled rotations": (lambda: Poses(RIGHT.positions, 1.01 * turned), "are no rotations"),
        "transposed axes": (
            lambda: Echoes.from_arrays(np.zeros(shape).swapaxes(2, 3), RIGHT, head),
            "spectrograms have shape",
        ),
        "decibels for magnitudes": (
            lambda: Echoes.from_arrays(np.full(shape, -40.0), RIGHT, head),
            "give linear magnitude, not decibels",
        ),
    }


OF_FITS = {
    "region 70 mm off": (
        ("region.lower=[-0.035, -0.035, 0.035]", "region.upper=[0.035, 0.035, 0.105]"),
        "hear echoes, and none from the region",
    ),
    "region in cm": (
        ("region.lower=[-3.5, -3.5, -3.5]", "region.upper=[3.5, 3.5, 3.5]"),
        "lie inside the region|memory",
    ),
    "too few poses for the region": (
        ("region.lower=[-0.14, -0.14, -0.14]", "region.upper=[0.14, 0.14, 0.14]"),
        "are few for a region",
    ),
}


def mistakes(count: int, seed: int, keep: Path) -> Report:
    """Make mistakes of physics and units; count those that are refused or named.

    Args:
        count: Number of mistakes; all where 0.
        seed: Seed of the choice.
        keep: Not used.
    """
    del keep
    report = Report("mistakes", seed)
    trials: list[tuple[str, Callable[[Path], str], str]] = []
    for name in OF_RECORDINGS:
        fault, words = {**FAULTS, **WARNED}[name]

        def heard(place: Path, fault: Callable[[Path], object] = fault) -> str:
            folder = shutil.copytree(place.parent / "sound", place / "recordings")
            fault(folder)
            return _of_import(folder)

        trials.append((name, heard, words))
    for name, (columns, values, words) in _of_points().items():

        def point(
            place: Path, columns: Iterable[str] = columns, values: np.ndarray = values
        ) -> str:
            _write_point(place / "recordings", columns, values)
            return _of_import(place / "recordings")

        trials.append((name, point, words))
    for name, (settings, words) in OF_SETTINGS.items():
        trials.append((name, lambda place, s=settings: _simulated(place, s), words))
    for name, (table, words) in _tables().items():

        def written(place: Path, table: str = table) -> str:
            (place / "poses.csv").write_text(table)
            path = ("poses.arrangement=path", "poses.path=poses.csv")
            return _simulated(place, path, leaving=("poses.count",))

        trials.append((name, written, words))
    for name, (make, words) in _of_objects().items():
        trials.append((name, lambda _, make=make: _raised(make), words))
    for name, (settings, words) in OF_FITS.items():
        trials.append((name, lambda place, s=settings: _fitted(place, s), words))
    if count:
        trials = random.Random(seed).sample(trials, min(count, len(trials)))
    with prepared(SIMULATE) as folder, tempfile.TemporaryDirectory() as other:
        write_folder(Path(other) / "sound", PINGS)
        assert "warning" not in _simulated(folder, ()), "a sound experiment raises an alarm"
        _write_point(folder / "sound", COLUMNS, _of_points()["recordings: rows off by one"][1][
            np.r_[1:24, 0]
        ])  # fmt: skip
        assert not (said := _of_import(folder / "sound")), said
        for number, (name, made, words) in enumerate(trials):
            place = Path(other) / f"{number}"
            place.mkdir()
            said = made(place)
            named = re.search(words, said)
            report.count("refused or named" if named else "unnoticed, or for another cause")
            if not named:
                report.fault(f"{name}: {said[-300:]!r}")
            shutil.rmtree(place)
    return report


def _simulated(place: Path, settings: Iterable[str], leaving: Iterable[str] = ()) -> str:
    base = [word for word in TINY if not word.startswith(tuple(leaving) or ("-",))]
    words = ("simulate", *base, *settings, "--output", "tried", "--workers", "1")
    outcome = give(words, place)
    return outcome.said + "".join(f"\nTRACE {line}" for line in outcome.faults)


def _fitted(place: Path, settings: Iterable[str]) -> str:
    words = ("fit", *TINY, *settings, "fit.max_steps=1", "--output", "tried", "--workers", "1")
    return give(words, place).said


def _raised(make: Callable[[], object]) -> str:
    try:
        make()
    except SonoNerfError as error:
        return str(error)
    return "nothing was raised"
