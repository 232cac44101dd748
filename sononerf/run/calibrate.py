# SPDX-License-Identifier: MIT
"""Errors of a recording, found by a run and its surface, and a store without them."""

from __future__ import annotations

import hashlib
import math
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import trimesh
from numpy.typing import NDArray

from sononerf import storage
from sononerf.echoes.detection import seal_recorded
from sononerf.echoes.echoes import Echoes
from sononerf.echoes.memory_ensemble import Ensemble, seal
from sononerf.echoes.store import EnsembleStore
from sononerf.errors import IncompatibleError, SettingsError
from sononerf.geometry.poses import KEYS, Poses
from sononerf.head.call import attach
from sononerf.head.head import Head
from sononerf.head.row_filters import row_widths
from sononerf.numerics import Floats
from sononerf.progress import Progress
from sononerf.refinement.optics import Optics
from sononerf.refinement.self_calibration import (
    KINDS,
    Calibration,
    Calibrator,
    ErrorKind,
    Estimate,
    above,
    find_support,
    with_support,
)
from sononerf.run.run import Run
from sononerf.settings.schema import SpectrogramSettings

DECIBELS = 20.0 / math.log(10.0)
"""Decibels of a natural logarithm of magnitude."""


def write_corrected(
    echoes: Echoes, output: Path, calibration: Calibration, progress: Progress
) -> EnsembleStore:
    """Write echoes without the errors of their recording; an interrupted call resumes."""
    store, head = echoes.store, echoes.head
    sections = head.plain()
    speed = head.speed_of_sound * math.exp(calibration.speed_of_sound)
    axis = np.asarray(store.range, dtype=np.float64)
    if calibration.speed_of_sound:
        axis = axis * math.exp(calibration.speed_of_sound)
        step = axis[1] - axis[0]
        # The same slices: limits that lie between them do not depend on rounding.
        limits = {
            "range_min": float(axis[0] - step / 4.0),
            "range_max": float(axis[-1] + step / 4.0),
        }
        sections["air"] = {**sections["air"], "speed_of_sound": speed}
        sections["spectrogram"] = {**sections["spectrogram"], **limits}
    earlier = store.attributes
    kept = ("origin", "source", "licence", "format", "units", "import", *KEYS)
    with storage.lock(output):
        made = EnsembleStore.create(
            output,
            positions=store.positions,
            rotations=store.rotations,
            split=store.split,
            range=axis,
            frequency=store.frequency,
            attributes={
                **{name: earlier[name] for name in kept if name in earlier},
                "echo_hash": f"{earlier['echo_hash']}-{_fingerprint(calibration, head)}",
                "settings": sections,
                "speed_of_sound": speed,
                "calibration": {
                    **(earlier.get("calibration") or {}),
                    "self_calibration": {
                        "of": str(store.path),
                        "gain_db": (calibration.gain * DECIBELS).round(3).tolist(),
                        "range_offset_m": calibration.range_offset,
                        "speed_of_sound": speed,
                        "support": sections["support"],
                    },
                },
            },
            receivers=store.receivers,
        )
        attach(head, output)
        factor = np.exp(-calibration.gain)[:, None]
        with progress.task("writing", len(store)) as task:
            for index in made.missing():
                heard = moved(
                    store.read_pose(index), np.asarray(store.range), calibration.range_offset
                )
                made.write_pose(index, (factor * heard).astype(np.float32))
                task.advance()
        poses = Poses(made.positions, made.rotations)
        silent = f"{output}: no pose heard anything"
        if earlier.get("origin") == "recorded":
            seal_recorded(made, head, poses, made.split, silent=silent)
        else:
            seal(made, {}, silent=silent)
    return EnsembleStore.open(output)


def moved(magnitude: NDArray[np.floating], axis: NDArray[np.floating], offset: float) -> Floats:
    """Return magnitudes (E, R, F) that are heard so much nearer (m), between slices linearly."""
    if offset == 0.0:
        return np.asarray(magnitude, dtype=np.float64)
    at = (axis + offset - axis[0]) / (axis[1] - axis[0])
    first = np.floor(at).astype(int)
    part = (at - first)[:, None]
    last = len(axis) - 1
    low, high = (magnitude[:, np.clip(first + more, 0, last)] for more in (0, 1))
    return np.asarray((1.0 - part) * low + part * high, dtype=np.float64)


def _fingerprint(calibration: Calibration, head: Head) -> str:
    plane = head.plane
    values = np.concatenate(
        [
            calibration.gain.ravel(),
            [calibration.range_offset, calibration.speed_of_sound],
            [] if plane is None else [*plane.point, *plane.normal],
        ]
    )
    return hashlib.sha256(np.round(values, 9).astype("<f8").tobytes()).hexdigest()[:12]


MAX_STEPS = 20
"""Largest number of Gauss-Newton steps; they usually end earlier."""
CONVERGED = 0.1
"""Length of a step, standard deviations, below which the iteration ends."""
MAX_LENGTH_ERROR = 0.25
"""Largest uncertainty of a length, range resolutions, at which an error counts as found."""
MAX_GAIN_ERROR_DB = 1.0
"""Largest uncertainty of a gain, dB, at which it counts as found."""
MAX_HEIGHT_ERROR = 1.0
"""Largest uncertainty of the support's height, range resolutions, at which it counts as found."""
ON_CYLINDER = 0.02
"""Largest range of the poses' distances from the axis of a turntable, over their mean."""


@dataclass(frozen=True, eq=False)
class Calibrated:
    """A corrected store."""

    store: EnsembleStore  # Complete; opened for reading
    estimate: Estimate  # The errors that were removed
    lines: list[str]  # Results, one line each
    warnings: list[str]  # Errors that the echoes do not determine


def kinds_of(names: Sequence[str]) -> tuple[ErrorKind, ...]:
    """Return the kinds of errors by name."""
    unknown = [name for name in names if name not in KINDS]
    if unknown or not names:
        found = f"unknown error {unknown[0]!r}" if unknown else "no error is given"
        raise SettingsError(f"{found}; known: {', '.join(KINDS)}")
    return tuple(kind for kind in KINDS if kind in names)


def calibrate(
    source: Path, output: Path, kinds: Sequence[str], *, progress: Progress | None = None
) -> Calibrated:
    """Estimate errors of the recording behind a run, and write a corrected store."""
    progress = progress or Progress(quiet=True)
    if output.exists() and any(output.iterdir()):
        raise IncompatibleError(f"{output}: holds something already; choose another --output")
    parameters = kinds_of(kinds)
    if (source / "zarr.json").is_file():
        raise SettingsError(
            f"{source}: a store; {parameters[0]} is found by a surface: fit first, and name the run"
        )
    opened = Run.of(source)
    echoes, mesh = opened.echoes, opened.mesh()
    storage.remove_if_empty(storage.probe_writable(output))
    bounds: dict[str, float] = {}
    if "support" in parameters:
        if echoes.head.plane is not None:
            raise SettingsError(
                "support: this run was fitted with one; fit without support.point first, so that "
                "the surface shows the image"
            )
        echoes, mesh, bounds["support"] = _with_support(echoes, mesh, progress)
    estimate = _estimate(
        echoes, mesh, [kind for kind in parameters if kind not in bounds], progress
    )
    estimate.deviation.update(bounds)
    corrected = write_corrected(echoes, output, estimate.calibration, progress)
    return Calibrated(
        corrected,
        estimate,
        *describe_estimate(echoes.head, echoes.store, mesh, estimate, parameters),
    )


def _is_turntable(positions: Floats) -> bool:
    """Return True if poses (P, 3), m, are at one distance from the z axis."""
    distance = np.linalg.norm(positions[:, :2], axis=1)
    return bool(np.ptp(distance) < ON_CYLINDER * distance.mean())


def _with_support(
    echoes: Echoes, mesh: trimesh.Trimesh, progress: Progress
) -> tuple[Echoes, trimesh.Trimesh, float]:
    """Return echoes with the support under the surface, and the part of the surface above it.

    The third value is the standard deviation of its height, m.
    """
    with progress.task("searching the support", 100) as task:

        def shown(share: float) -> None:
            task.advance(round(100 * share) - task.done)

        height, deviation = find_support(mesh, echoes, shown)
    head = with_support(echoes.head, height)
    return Echoes(echoes.store, head, echoes.hull), above(mesh, height), deviation


def _estimate(
    echoes: Echoes, mesh: trimesh.Trimesh, kinds: Sequence[ErrorKind], progress: Progress
) -> Estimate:
    head = echoes.head
    if not kinds:
        nothing = np.zeros((len(head.receivers), len(head.frequency)))
        return Estimate(Calibration(nothing), {}, [])
    work = Calibrator(
        mesh, echoes, Optics(head), kinds, dependent=dependent_cells(head.spectrogram)
    )
    with progress.task("calibrating", MAX_STEPS * len(work.poses)) as task:
        for _ in range(MAX_STEPS):
            work.step(task.advance)
            if work.change < CONVERGED:
                break
    return work.result()


def dependent_cells(spectrogram: SpectrogramSettings) -> float:
    """Return the number of cells of a spectrogram that share their noise, no unit, 1 or more."""
    frequency = np.linspace(spectrogram.frequency_min, spectrogram.frequency_max, 64)
    duration, bandwidth = (part.mean() for part in row_widths(spectrogram, frequency))
    rows = (
        spectrogram.channels
        if spectrogram.kind == "gammatone"
        else (spectrogram.frequency_max - spectrogram.frequency_min)
        / (spectrogram.sampling_rate / spectrogram.fft)
    )
    spacing = (spectrogram.frequency_max - spectrogram.frequency_min) / rows
    slices = duration * spectrogram.sampling_rate / spectrogram.hop
    return max(float(slices * bandwidth / spacing), 1.0)


def describe_estimate(
    head: Head, store: Ensemble, mesh: trimesh.Trimesh, estimate: Estimate, kinds: Sequence[str]
) -> tuple[list[str], list[str]]:
    """Return results and undetermined errors, one line each."""
    calibration, deviation, error = estimate.calibration, estimate.deviation, estimate.error_db
    away = store.positions[store.indices("train")] - mesh.centroid
    distance = np.linalg.norm(away, axis=1)
    lines, warnings = [], []

    def say(kind: str, text: str, warning: str, *, vague: bool) -> None:
        lines.append(f"{kind.replace('_', ' ') + ':':15s} {text}")
        if vague:
            warnings.append(f"{kind}: {warning}")

    if error:
        change = f"{error[0]:.2f} dB before, {error[-1]:.2f} dB after {len(error)} steps"
        say("error", change, "", vague=False)
    if "gain" in kinds:
        uncertain = DECIBELS * deviation["gain"]
        gains = ", ".join(f"{DECIBELS * value:+.2f}" for value in calibration.gain.mean(axis=1))
        text = f"{gains} dB in the mean over frequency, each ± {uncertain:.2f} dB"
        vague = uncertain > MAX_GAIN_ERROR_DB
        say("gain", text, "the echoes do not determine it", vague=vague)
    if "range_offset" in kinds:
        uncertain = deviation["range_offset"]
        text = f"{1e3 * calibration.range_offset:+.2f} ± {1e3 * uncertain:.2f} mm"
        vague = uncertain > MAX_LENGTH_ERROR * head.resolution
        warning = "the echoes do not separate it from the size of the object"
        say("range_offset", text, warning, vague=vague)
    if "range_offset" in kinds and _is_turntable(store.positions):
        warnings.append(
            "range_offset: all poses are those of a turntable, where a larger object sounds nearly "
            "the same; the stated uncertainty does not hold; measure it with a reference target "
            "(import.reference)"
        )
    if {"gain", "range_offset"} <= set(kinds):
        warnings.append(
            "gain and range_offset together: a larger object is louder and nearer, so both may be "
            "wrong together; calibrate one of them by a reference target (import.reference)"
        )
    if "support" in kinds and head.plane is not None:
        height = float(np.dot(head.plane.point, head.plane.normal))
        uncertain = deviation["support"]
        text = f"{1e3 * height:.1f} ± {1e3 * uncertain:.1f} mm"
        vague = uncertain > MAX_HEIGHT_ERROR * head.resolution
        say("support", text, "the echoes hardly determine it; measure it", vague=vague)
    if "speed_of_sound" in kinds:
        uncertain, speed = deviation["speed_of_sound"], head.speed_of_sound
        text = f"{speed * math.exp(calibration.speed_of_sound):.2f} ± {speed * uncertain:.2f} m/s"
        vague = uncertain * distance.mean() > MAX_LENGTH_ERROR * head.resolution
        warning = (
            "all poses are at one distance, so it cannot be separated from the size of the "
            "object; record from several distances"
        )
        say("speed_of_sound", text, warning, vague=vague or distance.std() < head.resolution)
    return lines, warnings
