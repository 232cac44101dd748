# SPDX-License-Identifier: MIT
"""Plan of an import: recordings, poses and settings, completed by each other and checked."""

from __future__ import annotations

from collections.abc import Callable, Iterable
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from sononerf.echoes.memory_ensemble import draw_split, split_of
from sononerf.errors import InputError, NumericalError, SettingsError
from sononerf.geometry.poses import Poses
from sononerf.head.call import call_content, call_waveform
from sononerf.head.front_end import echo_samples
from sononerf.head.head import Head
from sononerf.head.reception import warn_of_band
from sononerf.numerics import Ints
from sononerf.progress import Progress
from sononerf.recordings.pose_tables import to_poses
from sononerf.recordings.ranges import calibrated, range_limits
from sononerf.recordings.readers import (
    read_airsas,
    read_folder,
    read_numpy,
    read_sononerf_matlab,
    read_sonotracelab,
)
from sononerf.recordings.recording import (
    Channel,
    Cutter,
    Recording,
    channels_of,
    check_channels,
    check_numbers,
    clipped_pings,
    mixed_channels,
)
from sononerf.run.build import head_of
from sononerf.settings.loading import (
    apply_override,
    read_import_settings,
    read_yaml,
    validate_settings,
)
from sononerf.settings.schema import FILE_SECTIONS, HEAD_SECTIONS, CallSettings, Settings
from sononerf.settings.sections import ImportSettings

FOLDER = "recordings"
READERS: dict[str, Callable[[Path, ImportSettings], Recording]] = {
    FOLDER: read_folder,
    "numpy": read_numpy,
    "sonotracelab": read_sonotracelab,
    "sononerf-matlab": read_sononerf_matlab,
    "airsas": read_airsas,
}
OWN_SETTINGS = "import.yaml"


@dataclass(frozen=True, eq=False)
class ImportPlan:
    """Validated recording, poses and settings."""

    form: str  # Format of the source
    recording: Recording  # All pings that were read
    settings: Settings  # Air, ears, call and spectrogram, complete
    options: ImportSettings  # Settings of the import
    cutter: Cutter  # Cuts and calibrates pings
    head: Head  # Head of these settings
    pings: Ints  # (P,): Numbers of the pings that are kept
    poses: Poses  # Poses of all pings of the recording
    split: NDArray[np.int8]  # (P,) int8: Split of the kept pings
    clipped: int  # Number of rejected pings
    channels: list[Channel]  # State of each receiver's channel
    lengths: tuple[float, float]  # (N,), s: Shortest and longest ping, from the emission on
    calibration: dict[str, Any]  # The applied calibration, as plain data
    notes: tuple[str, ...]  # Interpretations that may surprise


def plan_import(
    form: str,
    source: Path,
    output: Path,
    *,
    settings_file: Path | None = None,
    overrides: Iterable[str] = (),
    progress: Progress | None = None,
) -> ImportPlan:
    """Read recordings and settings, and complete each by the other."""
    if form not in READERS:
        raise SettingsError(f"unknown format {form!r}; known: {', '.join(READERS)}")
    if not source.exists():
        raise InputError(f"{source}: no such file or folder")
    if form != "recordings" and source.is_dir():
        raise InputError(f"{source}: is a folder; the format {form} is one file")
    folder = source if source.is_dir() else source.parent
    where, data = _settings_data(folder, settings_file, overrides)
    import_settings = read_import_settings(data.pop("import", None) or {}, where)
    progress = progress or Progress(quiet=True)
    if form == FOLDER:
        recording = read_folder(source, import_settings, _named_files(data))
    else:
        recording = READERS[form](source, import_settings)
    settings = _complete(data, recording, import_settings, output, where)
    head = head_of(settings)
    receivers = len(head.receivers)
    heard = len(mixed_channels(np.zeros((recording.read(0).shape[0], 1)), import_settings.channels))
    if heard != receivers:
        raise InputError(
            f"{recording.path}: {heard} channels, and the settings describe {receivers} "
            "receivers; set ears.receivers to one place for each channel, or choose channels with "
            "import.channels"
        )
    poses = to_poses(recording.columns, import_settings)
    if len(poses) != len(recording):
        raise InputError(f"{recording.path}: {len(recording)} pings and {len(poses)} poses")
    check_channels(recording, import_settings.channels)
    cutter, calibration = calibrated(recording, import_settings, head, folder)
    if import_settings.compress:
        warn_of_band(settings.call, settings.spectrogram)
        cutter = replace(cutter, call=call_waveform(settings.call, recording.sampling_rate))
        calibration["compressed"] = call_content(settings.call)
        settings = settings.model_copy(update={"call": CallSettings()})
    check_numbers(recording, cutter, 0)
    limits, power = range_limits(
        head_of(settings), cutter, recording, data.get("spectrogram", {}), progress
    )
    if not power.any():
        raise NumericalError(f"{recording.path}: all recordings are silent; check the channels")
    plain = settings.plain()
    plain["spectrogram"] |= limits
    settings = validate_settings(plain, settings.source or "import")
    head = head_of(settings)
    check_numbers(recording, cutter, head.samples)
    kept, clipped = _without_clipped(recording, cutter, head, import_settings)
    stated, where = recording.columns.take(kept).split(), str(recording.path)
    if stated is not None:
        split = split_of(poses[kept], stated, where=f"{where}: column split")
    else:
        split = draw_split(
            poses[kept],
            validation=import_settings.validation,
            heldout=import_settings.heldout,
            seed=import_settings.seed,
            where=where,
        )
    there = [cutter.samples(index) / recording.sampling_rate for index in range(len(recording))]
    return ImportPlan(
        form=form,
        recording=recording,
        settings=settings,
        options=import_settings,
        cutter=cutter,
        head=head,
        pings=kept,
        poses=poses,
        split=split,
        clipped=clipped,
        channels=channels_of(power, head.point_echo.looks),
        lengths=(min(there), max(there)),
        calibration=calibration,
        notes=recording.notes,
    )


def _named_files(data: dict[str, Any]) -> list[Path]:
    """Return the files that sections of the head name, such as the recording of the call."""
    sections = [data.get(name) for name in FILE_SECTIONS]
    named = [each.get("file") for each in sections if isinstance(each, dict)]
    return [Path(str(file)).absolute() for file in named if file]


def _settings_data(
    folder: Path, settings_file: Path | None, overrides: Iterable[str]
) -> tuple[str, dict[str, Any]]:
    if settings_file is None and (folder / OWN_SETTINGS).is_file():
        settings_file = folder / OWN_SETTINGS
    data = {} if settings_file is None else read_yaml(settings_file)
    for section in FILE_SECTIONS:  # such paths are relative, like all of the import
        named = data.get(section)
        if settings_file is not None and isinstance(named, dict) and named.get("file"):
            named["file"] = str(settings_file.parent / str(named["file"]))
    for assignment in overrides:
        apply_override(data, assignment)
    where = "command line" if settings_file is None else str(settings_file)
    unknown = [name for name in data if name not in (*HEAD_SECTIONS, "import")]
    if unknown:
        raise SettingsError(
            f"{where}: {unknown[0]}: no section of an import; known: import, "
            + ", ".join(HEAD_SECTIONS)
        )
    return where, data


def _complete(
    data: dict[str, Any],
    recording: Recording,
    import_settings: ImportSettings,
    output: Path,
    where: str,
) -> Settings:
    """Complete the settings from the recording, and check them like those of a fit."""
    for section, stated in recording.settings.items():
        own = data.setdefault(section, {})
        if isinstance(own, dict):
            data[section] = {**_mixed(stated, import_settings), **own}
    support = data.setdefault("support", {})
    table = import_settings.turntable
    if table is not None and table.surface is not None and isinstance(support, dict):
        support.setdefault("point", [0.0, 0.0, table.surface])
    spectrogram = data.setdefault("spectrogram", {})
    if isinstance(spectrogram, dict):
        rate = spectrogram.setdefault("sampling_rate", recording.sampling_rate)
        if rate != recording.sampling_rate:
            raise SettingsError(
                f"{where}: spectrogram.sampling_rate is {rate}, the recordings have "
                f"{recording.sampling_rate:g} Hz; leave it out"
            )
    settings = validate_settings({**data, "data": {"store": str(output)}}, where)
    band = {"frequency_min", "frequency_max"}
    if settings.call.bands and not band & settings.spectrogram.model_fields_set:
        ends = np.asarray(list(settings.call.bands.values()))
        data["spectrogram"] |= {
            "frequency_min": float(ends.min()),
            "frequency_max": min(float(ends.max()), recording.sampling_rate / 2.0),
        }
        settings = validate_settings({**data, "data": {"store": str(output)}}, where)
    return settings


def _mixed(stated: dict[str, Any], import_settings: ImportSettings) -> dict[str, Any]:
    """Return the source's statements about receivers, for the chosen channels."""
    if "receivers" not in stated or import_settings.channels is None:
        return stated
    places = mixed_channels(
        np.asarray(stated["receivers"], dtype=np.float64), import_settings.channels
    )
    return {**stated, "receivers": places.tolist()}


def _without_clipped(
    recording: Recording, cutter: Cutter, head: Head, import_settings: ImportSettings
) -> tuple[Ints, int]:
    """Return the pings to keep, and how many are clipped where their echoes are."""
    if not import_settings.reject_clipped:
        return np.arange(len(recording)), 0
    spectrogram, speed = head.spectrogram, head.speed_of_sound
    first = int(
        spectrogram.range_min * 2.0 / speed * spectrogram.sampling_rate - spectrogram.window / 2.0
    )
    last = echo_samples(spectrogram, speed)
    found = [cutter.clipped(index, max(first, 0), last) for index in range(len(recording))]
    bad = clipped_pings(found)
    if bad.all():
        raise InputError(
            f"{recording.path}: all {len(bad)} pings are clipped where echoes are; record with "
            "less gain, or set import.reject_clipped=false"
        )
    return np.flatnonzero(~bad), int(bad.sum())
