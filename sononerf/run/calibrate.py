# SPDX-License-Identifier: MIT
"""Self-calibration: errors of a recording are found by a run's surface, and taken off a store."""

from __future__ import annotations

import hashlib
import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import trimesh
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from sononerf import storage
from sononerf.array_types import Floats
from sononerf.echoes.echoes import Echoes
from sononerf.echoes.memory_ensemble import Ensemble, seal
from sononerf.echoes.recorded_noise import seal_recorded
from sononerf.echoes.store import EnsembleStore
from sononerf.errors import IncompatibleError, SettingsError
from sononerf.geometry.frame import KEYS
from sononerf.geometry.poses import Poses
from sononerf.head.attached import attach
from sononerf.head.head import Head
from sononerf.head.row_filters import row_widths
from sononerf.progress import Progress
from sononerf.recordings.lag import LAGS, find_lag, is_path, later
from sononerf.recordings.pose_check import Consistency
from sononerf.run.run_folder import RunFolder
from sononerf.settings.schema import SpectrogramSettings
from sononerf.surface.refine.optics import Optics
from sononerf.surface.refine.recording_errors import (
    KINDS,
    Calibration,
    Estimate,
    Kind,
    changed_head,
    outward,
)
from sononerf.surface.refine.self_calibration import Calibrator
from sononerf.surface.refine.support_search import above, find_support, with_support

STEPS = 20
"""At most so many Gauss-Newton steps; they usually end earlier."""
SETTLED = 0.1
"""Steps end when they are shorter than this, standard deviations."""
DETERMINED = 0.25
"""Largest uncertainty of a length, range resolutions, at which an error counts as found."""
DETERMINED_DB = 1.0
"""The same of a gain, dB."""
DETERMINED_RESOLUTIONS = 1.0
"""Largest uncertainty of the turntable's radius, the support's height and the emitter's radius,
range resolutions, at which they count as found."""
ON_CYLINDER = 0.02
"""Largest range of the poses' distances from the axis of a turntable, over their mean."""
LAG = "lag"
"""Name of the lag of poses behind pings, which is found from first echoes alone."""
DETERMINED_ROWS = 0.5
"""Largest uncertainty of a lag, rows, at which it counts as found."""
INFORMED = 0.7
"""Largest uncertainty of a pose over the spread of all poses, no unit, at which the echoes say more
than the spread does."""
_DB = 20.0 / math.log(10.0)


@dataclass(frozen=True, eq=False)
class Calibrated:
    """A corrected store.

    Attributes:
        store: Complete; opened for reading.
        estimate: What was taken off.
        lines: What was found, one line each.
        warnings: What the echoes do not determine.
    """

    store: EnsembleStore
    estimate: Estimate
    lines: list[str]
    warnings: list[str]


def kinds_of(names: Sequence[str]) -> tuple[Kind, ...]:
    """Return the kinds of errors by name.

    Raises:
        SettingsError: If a name is unknown, or there is none.
    """
    unknown = [name for name in names if name not in KINDS]
    if unknown or not names:
        found = f"unknown error {unknown[0]!r}" if unknown else "no error is given"
        raise SettingsError(f"{found}; known: {', '.join((LAG, *KINDS))}")
    return tuple(kind for kind in KINDS if kind in names)


def calibrate(
    source: Path, output: Path, kinds: Sequence[str], *, progress: Progress | None = None
) -> Calibrated:
    """Find errors of the recording that a run was fitted to, and write a corrected store.

    Args:
        source: Folder of a run with a surface; for the lag, a store too.
        output: The corrected store; the source's own store is left as it is.
        kinds: Which errors, of :data:`KINDS`, or :data:`LAG` alone.
        progress: Where to show it.

    Raises:
        SettingsError: If a kind is unknown, or the poses are not those of a turntable (``radius``)
            or of a path (``lag``).
        InputError: If the run has no surface, or its echoes are not there.
        IncompatibleError: If there is a store at ``output`` already.
    """
    progress = progress or Progress(quiet=True)
    if output.exists() and any(output.iterdir()):
        raise IncompatibleError(f"{output}: holds something already; choose another --output")
    if LAG in kinds:
        return _without_lag(source, output, kinds, progress)
    wanted = kinds_of(kinds)
    if _is_store(source):
        raise SettingsError(
            f"{source}: a store; {wanted[0]} is found by a surface: fit first, and name the run"
        )
    opened = RunFolder.of(source)
    echoes, mesh = opened.echoes, opened.mesh()
    if "radius" in wanted:
        _check_cylinder(echoes)
    storage.remove_if_empty(storage.probe_writable(output))
    store = echoes.store
    known: dict[str, float] = {}
    if "support" in wanted and echoes.head.plane is None:
        echoes, mesh, known["support"] = _with_support(echoes, mesh, progress)
    left = tuple(kind for kind in wanted if kind not in known)
    estimate = _estimate(echoes, mesh, left, progress)
    estimate.deviation.update(known)
    corrected = _write(echoes, output, estimate.calibration, wanted, progress)
    lines, warnings = describe(echoes.head, store, mesh, estimate, wanted)
    return Calibrated(corrected, estimate, lines, warnings)


def _is_store(source: Path) -> bool:
    return (source / "zarr.json").is_file()


def _without_lag(
    source: Path, output: Path, kinds: Sequence[str], progress: Progress
) -> Calibrated:
    """Write a store whose poses are those of their pings; see :func:`calibrate`."""
    if set(kinds) != {LAG}:
        raise SettingsError(f"{LAG} is found before a surface is known: calibrate it alone")
    echoes = Echoes.open(source) if _is_store(source) else RunFolder.of(source).echoes
    store, head = echoes.store, echoes.head
    poses, onsets = Poses(store.positions, store.rotations), echoes.onsets
    if not is_path(poses):
        raise SettingsError(
            f"{LAG}: successive poses are no neighbours, so the places between them are unknown; "
            f"leave {LAG} out"
        )
    check = Consistency(head.emitter, head.receivers, head.resolution)
    with progress.task("searching the lag", len(LAGS)) as task:
        rows, deviation = find_lag(poses, onsets.first, onsets.poses, check, task.advance)
    storage.remove_if_empty(storage.probe_writable(output))
    moved_on = later(poses, rows)
    found = replace(
        Calibration.none(len(head.receivers), len(poses)),
        position=moved_on.positions - poses.positions,
        aim=Rotation.from_matrix(
            moved_on.rotations @ poses.rotations.transpose(0, 2, 1)
        ).as_rotvec(),
    )
    uncertain = "the first echoes hardly tell; compare the clocks"
    return Calibrated(
        _write(echoes, output, found, (), progress),
        Estimate(found, {LAG: deviation}, []),
        [f"lag:            ping n belongs to row n {rows:+.2f} ± {deviation:.2f} of the poses"],
        [f"{LAG}: {uncertain}"] if deviation > DETERMINED_ROWS else [],
    )


def _check_cylinder(echoes: Echoes) -> None:
    distance = np.linalg.norm(echoes.positions[:, :2], axis=1)
    if np.ptp(distance) > ON_CYLINDER * distance.mean():
        raise SettingsError(
            "radius: the poses are not those of a turntable: their distances from the z axis are "
            f"{distance.min():.3g} to {distance.max():.3g} m; leave radius out"
        )


def _with_support(
    echoes: Echoes, mesh: trimesh.Trimesh, progress: Progress
) -> tuple[Echoes, trimesh.Trimesh, float]:
    """Return the echoes above the support that the surface stands on, and what is above it.

    The third value is the standard deviation of its height, m.
    """
    with progress.task("searching the support", 100) as task:

        def shown(share: float) -> None:
            task.advance(round(100 * share) - task.done)

        height, deviation = find_support(mesh, echoes, shown)
    head = with_support(echoes.head, height)
    return Echoes(echoes.store, head, echoes.hull), above(mesh, height), deviation


def _estimate(
    echoes: Echoes, mesh: trimesh.Trimesh, kinds: Sequence[Kind], progress: Progress
) -> Estimate:
    head = echoes.head
    if not kinds:
        nothing = Calibration.none(len(head.receivers), len(echoes.store))
        return Estimate(nothing, {}, [])
    work = Calibrator(mesh, echoes, Optics(head), kinds, dependent=dependent_cells(head.analysis))
    with progress.task("calibrating", STEPS * len(work.poses)) as task:
        for _ in range(STEPS):
            work.step(task.advance)
            if work.change < SETTLED:
                break
    return work.result()


def dependent_cells(analysis: SpectrogramSettings) -> float:
    """Return how many cells of a spectrogram share their noise, no unit, 1 or more."""
    frequency = np.linspace(analysis.frequency_min, analysis.frequency_max, 64)
    duration, bandwidth = (part.mean() for part in row_widths(analysis, frequency))
    rows = (
        analysis.channels
        if analysis.kind == "gammatone"
        else (analysis.frequency_max - analysis.frequency_min)
        / (analysis.sampling_rate / analysis.fft)
    )
    spacing = (analysis.frequency_max - analysis.frequency_min) / rows
    slices = duration * analysis.sampling_rate / analysis.hop
    return max(float(slices * bandwidth / spacing), 1.0)


def _write(
    echoes: Echoes,
    output: Path,
    found: Calibration,
    kinds: Sequence[Kind],
    progress: Progress,
) -> EnsembleStore:
    """Write the store without the errors; see :func:`calibrate`."""
    store, head = echoes.store, changed_head(echoes.head, found.support, found.beam_radius)
    sections = head.plain()
    speed = head.speed_of_sound * math.exp(found.speed_of_sound)
    axis = np.asarray(store.range, dtype=np.float64)
    if "speed_of_sound" in kinds:
        axis = axis * math.exp(found.speed_of_sound)
        step = axis[1] - axis[0]
        # The same slices: limits that lie between them do not depend on rounding.
        limits = {
            "range_min": float(axis[0] - step / 4.0),
            "range_max": float(axis[-1] + step / 4.0),
        }
        sections["air"] = {**sections["air"], "speed_of_sound": speed}
        sections["spectrogram"] = {**sections["spectrogram"], **limits}
    turned = Rotation.from_rotvec(found.aim).as_matrix()
    positions = store.positions + found.position + found.radius * outward(store.positions)
    earlier = store.attributes
    kept = ("origin", "source", "licence", "format", "units", "import", *KEYS)
    with storage.lock(output):
        made = EnsembleStore.create(
            output,
            poses_positions=positions,
            poses_rotations=turned @ store.rotations,
            split=store.split,
            range=axis,
            frequency=store.frequency,
            attributes={
                **{name: earlier[name] for name in kept if name in earlier},
                "echo_hash": f"{earlier['echo_hash']}-{_fingerprint(found)}",
                "settings": sections,
                "speed_of_sound": speed,
                "calibration": {
                    **(earlier.get("calibration") or {}),
                    "self_calibration": {
                        "of": str(store.path),
                        "gain_db": (found.gain * _DB).tolist(),
                        "range_offset_m": found.range_offset,
                        "speed_of_sound": speed,
                        "radius_m": found.radius,
                        "beam_radius_m": found.beam_radius,
                        "support": sections["support"],
                    },
                },
            },
            receivers=store.receivers,
        )
        attach(head, output)
        factor = np.exp(-found.gain)[:, None, None]
        with progress.task("writing", len(store)) as task:
            for index in made.missing():
                heard = moved(store.read_pose(index), np.asarray(store.range), found.range_offset)
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


def _fingerprint(found: Calibration) -> str:
    values = np.concatenate(
        [
            found.gain,
            [found.range_offset, found.speed_of_sound],
            [found.radius, found.support, found.beam_radius],
            found.position.ravel(),
            found.aim.ravel(),
        ]
    )
    return hashlib.sha256(np.round(values, 9).astype("<f8").tobytes()).hexdigest()[:12]


def describe(
    head: Head,
    store: Ensemble,
    mesh: trimesh.Trimesh,
    estimate: Estimate,
    kinds: Sequence[Kind],
) -> tuple[list[str], list[str]]:
    """Return what was found and what is not determined, one line each.

    Args:
        head, store, mesh: Of the run.
        estimate: What was found.
        kinds: What was looked for.
    """
    found, deviation = estimate.calibration, estimate.deviation
    train = store.indices("train")
    reach = float(np.linalg.norm(store.positions[train] - mesh.centroid, axis=1).mean())
    resolution, speed = head.resolution, head.speed_of_sound
    error = estimate.error_db
    lines = []
    if error:
        steps = f"{error[-1]:.2f} dB after {len(error)} steps"
        lines.append(f"error:          {error[0]:.2f} dB before, {steps}")
    warnings = []
    if "gain" in kinds:
        gains = ", ".join(f"{_DB * value:+.2f}" for value in found.gain)
        lines.append(f"gain:           {gains} dB, each ± {_DB * deviation['gain']:.2f} dB")
        if _DB * deviation["gain"] > DETERMINED_DB:
            warnings.append("gain: the echoes do not determine it")
    if "range_offset" in kinds:
        off, uncertain = 1e3 * found.range_offset, deviation["range_offset"]
        lines.append(f"range offset:   {off:+.2f} ± {1e3 * uncertain:.2f} mm")
        if uncertain > DETERMINED * resolution:
            warnings.append(
                "range_offset: the echoes do not separate it from the size of the object"
            )
    if {"gain", "range_offset"} <= set(kinds):
        warnings.append(
            "gain and range_offset together: a larger object is louder and nearer, so both may be "
            "wrong together; calibrate one of them by a reference target (import.reference)"
        )
    distance = float(np.linalg.norm(store.positions[train][:, :2], axis=1).mean())
    plane = head.plane
    for kind, name, before in (
        ("radius", "radius", distance),
        ("support", "support", None if plane is None else float(np.dot(plane.point, plane.normal))),
        ("beam_radius", "beam radius", head.ears.beam_radius),
    ):
        if kind not in kinds or before is None:
            continue
        now, uncertain = before + getattr(found, kind), deviation[kind]
        lines.append(f"{name + ':':15s} {1e3 * now:.1f} ± {1e3 * uncertain:.1f} mm")
        if uncertain > DETERMINED_RESOLUTIONS * resolution:
            warnings.append(f"{kind}: the echoes hardly determine it; measure it")
    if "radius" in kinds:
        warnings.append(
            "radius: a surface that was fitted to a wrong radius hears nearly the same, and takes "
            "up most of the error; the stated uncertainty does not hold unless the surface is known"
        )
    if "radius" in kinds and "range_offset" in kinds:
        warnings.append(
            "radius and range_offset together: near and far poses alone tell them apart; their sum "
            "is found better than each"
        )
    if "speed_of_sound" in kinds:
        uncertain = deviation["speed_of_sound"]
        lines.append(
            f"speed of sound: {speed * math.exp(found.speed_of_sound):.2f} "
            f"± {speed * uncertain:.2f} m/s"
        )
        if uncertain * reach > DETERMINED * resolution or _one_distance(store, mesh, resolution):
            warnings.append(
                "speed_of_sound: all poses are at one distance, so it cannot be separated from "
                "the size of the object; record from several distances"
            )
    for kind, name, factor, unit in (
        ("position", "position", 1e3, "mm"),
        ("aim", "aim", math.degrees(1.0), "degrees"),
    ):
        if kind not in kinds:
            continue
        values = getattr(found, kind)[train]
        usual = math.sqrt(float(np.square(values).mean()))
        uncertain = deviation[kind]
        spread = math.hypot(usual, uncertain)
        lines.append(
            f"{name + ':':15s} {factor * usual:.2f} {unit} per axis, each ± "
            f"{factor * uncertain:.2f} {unit}"
        )
        if uncertain > INFORMED * spread:
            warnings.append(
                f"{kind}: the echoes hardly determine it; the poses stay about as they were"
            )
    return lines, warnings


def _one_distance(store: Ensemble, mesh: trimesh.Trimesh, resolution: float) -> bool:
    """Whether all training poses are at one distance, as far as ranges can be resolved."""
    away = np.linalg.norm(store.positions[store.indices("train")] - mesh.centroid, axis=1)
    return float(np.std(away)) < resolution
