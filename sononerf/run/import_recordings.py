# SPDX-License-Identifier: MIT
"""From recordings to a sealed ensemble of echoes: the plan, its check, and the store."""

from __future__ import annotations

import hashlib
import json
import logging
import tempfile
import time
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from sononerf import __version__, storage
from sononerf.echoes.detection import seal_recorded
from sononerf.echoes.echoes import Echoes
from sononerf.echoes.memory_ensemble import draw_split, split_of
from sononerf.echoes.store import EnsembleStore
from sononerf.errors import IncompatibleError, InputError, NumericalError, SettingsError
from sononerf.geometry.poses import Poses
from sononerf.head.call import attach, call_content, call_waveform
from sononerf.head.front_end import echo_samples
from sononerf.head.head import Head
from sononerf.head.reception import warn_of_band, warn_of_call
from sononerf.numerics import Ints, Singles
from sononerf.progress import Progress, duration
from sononerf.recordings.pose_check import MAX_PINGS, Verdict, alternatives, check_poses, shifted
from sononerf.recordings.pose_tables import original_frame, to_poses
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
    faults_of_channels,
    mixed_channels,
)
from sononerf.report.spectrogram_picture import pings_png
from sononerf.run.simulate import OWN_SETTINGS, head_of
from sononerf.settings.loading import (
    apply_override,
    assignments,
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
    settings = settings.model_copy(update={"spectrogram": head_of(settings).spectrogram})
    check_numbers(recording, cutter, 0)
    limits, power = range_limits(
        head_of(settings), cutter, recording, data.get("spectrogram", {}), progress
    )
    channels = channels_of(power, head.point_echo.looks)
    if not any(channel.heard for channel in channels):
        raise NumericalError(
            f"{recording.path}: all recordings are silent or noise, no ping holds an echo; check "
            "the channels, the range limits, and what the files hold"
        )
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
        channels=channels,
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
    if not {"frequency_min", "frequency_max"} & settings.spectrogram.model_fields_set:
        # With pulse compression too the band is that of the call.
        suiting = head_of(settings).spectrogram
        data["spectrogram"] |= {
            name: getattr(suiting, name) for name in ("frequency_min", "frequency_max")
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


logger = logging.getLogger("sononerf")

SHOWN_PINGS = 3  # pings in a picture
NOT_HASHED = ("source", "licence")
"""Keys that do not change the echoes."""
WRITTEN_SECONDS = 0.01
"""Time to write one ping durably, s, on a usual disk."""
MIN_COMPRESSION_GAIN = 1.5
"""Range resolution over that of an impulse, no unit, from which pulse compression is proposed; a
smaller gain would hardly be seen."""


def import_hash(plan: ImportPlan) -> str:
    """Return a hash of all that the echoes come from: samples, poses, settings."""
    plain = plan.settings.plain()
    digest = hashlib.sha256(f"recordings {plan.form}".encode())
    given = plan.options.model_dump(mode="json", exclude=set(NOT_HASHED))
    sections = {name: plain[name] for name in HEAD_SECTIONS}
    # Newer keys that do not apply leave the hash as older versions made it.
    if plan.head.plane is None:
        del sections["support"]
    for name, plain_value in (("inverse", None), ("euler", "zyx")):
        if given[name] == plain_value:
            del given[name]
    if given["turntable"] is not None and given["turntable"]["surface"] is None:
        del given["turntable"]["surface"]
    digest.update(json.dumps([given, sections, plan.calibration], sort_keys=True).encode())
    poses = plan.poses[plan.pings]
    for values in (poses.positions, poses.rotations):
        digest.update((np.round(values, 9) + 0.0).astype("<f8").tobytes())
    digest.update(plan.split.tobytes())
    digest.update(plan.pings.astype("<i8").tobytes())
    digest.update(np.round(plan.recording.emission, 12).astype("<f8").tobytes())
    digest.update(plan.cutter.digest(plan.head.samples))
    if plan.cutter.background is not None:
        digest.update(np.round(plan.cutter.background, 9).astype("<f8").tobytes())
    return digest.hexdigest()


def spectrogram_of(plan: ImportPlan, ping: int) -> Singles:
    """Return the spectrogram of one ping of the recording, (E, R, F)."""
    head = plan.head
    return head.analyse(plan.cutter.echo(ping, head.samples)).astype(np.float32)


def read_recordings(
    source: Path | str,
    output: Path | str,
    *,
    form: str = "recordings",
    options: Mapping[str, Any] | None = None,
    settings_file: Path | None = None,
    progress: Progress | None = None,
) -> Echoes:
    """Turn recordings into echoes, or open the echoes if they exist.

    Args:
        source: Folder of WAV files with ``poses.csv``, or a file.
        output: Folder of the store.
        form: ``recordings``, ``numpy``, ``sonotracelab``, ``sononerf-matlab`` or ``airsas``.
        options: Sections of the import's settings, such as ``{"air": {"temperature_c": 20},
            "ears": {"directivity": "omnidirectional"}, "import": {"frame": "ned"}}``.
        settings_file: Settings of the import; ``import.yaml`` beside the recordings by default.
        progress: Display of progress; on stderr by default.

    Returns:
        echoes: Complete. What the first echoes say against the poses is logged as a warning.

    Raises:
        SettingsError, InputError: If settings, recordings or poses are no good; nothing is written
            then.
        NumericalError: If no pose hears anything.
        StorageError: If the store cannot be written.
        IncompatibleError: If the folder holds another ensemble.
    """
    output = Path(output)
    chosen = assignments(options or {})
    progress = progress or Progress()
    plan = plan_import(
        form, Path(source), output, settings_file=settings_file, overrides=chosen, progress=progress
    )
    store, found = write_import(plan, output, progress=progress)
    if found.message:
        logger.warning("%s", found.message)
    return Echoes(store, plan.head)


def write_import(
    plan: ImportPlan, output: Path, *, progress: Progress | None = None
) -> tuple[EnsembleStore, Verdict]:
    """Write the store, and report the check of the poses by first echoes."""
    progress = progress or Progress(quiet=True)
    echoes_id = import_hash(plan)
    if (output / "zarr.json").is_file():
        store = EnsembleStore.open(output)
        if store.attributes.get("echo_hash") != echoes_id:
            raise IncompatibleError(f"{output}: holds other echoes; choose another --output")
        if store.is_sealed and not store.damaged():
            return store, verdict(plan, store)
    warn_of_call(plan.settings.call, plan.settings.spectrogram)
    poses = plan.poses[plan.pings]
    storage.probe_writable(output)
    with storage.lock(output):
        store = EnsembleStore.create(
            output,
            positions=poses.positions,
            rotations=poses.rotations,
            split=plan.split,
            range=plan.head.range,
            frequency=plan.head.frequency,
            attributes=_attributes(plan, echoes_id),
            receivers=len(plan.head.receivers),
        )
        store.remove_damaged()
        attach(plan.settings, output)
        missing = store.missing()
        with progress.task("importing", len(missing)) as task:
            for index in missing:
                store.write_pose(index, spectrogram_of(plan, int(plan.pings[index])))
                task.advance()
        silent = f"{output}: all recordings are silent; check the channels"
        seal_recorded(store, plan.head, poses, plan.split, silent=silent)
    store = EnsembleStore.open(output)
    return store, verdict(plan, store)


def _attributes(plan: ImportPlan, echoes_id: str) -> dict[str, Any]:
    plain = plan.settings.plain()
    return {
        "echo_hash": echoes_id,
        "origin": "recorded",
        "format": plan.form,
        "source": plan.options.source or plan.recording.path.name,
        "licence": plan.options.licence,
        "settings": {name: plain[name] for name in HEAD_SECTIONS},
        "import": plan.options.model_dump(mode="json"),
        **original_frame(plan.recording.columns, plan.options),
        "calibration": plan.calibration,
        "rejected_clipped": plan.clipped,
        "speed_of_sound": plan.head.speed_of_sound,
        "units": {
            "spectrogram": "linear magnitude, sound pressure over that of the call at 1 m"
            if plan.options.reference is not None
            else "linear magnitude, unit of the recording",
            "position": "m",
            "range": "m",
            "frequency": "Hz",
        },
        "sononerf": __version__,
    }


def verdict(plan: ImportPlan, store: EnsembleStore) -> Verdict:
    """Return the check of pose conventions by the first echoes of the training poses."""
    heard = Echoes(store, plan.head).onsets
    table, pings = plan.recording.columns, plan.pings[heard.poses]
    others = alternatives(table.take(pings), plan.options)
    return check_poses(
        heard.first,
        plan.poses[plan.pings[heard.poses]],
        others | shifted(table, pings, plan.options),
        emitter=plan.head.emitter,
        receivers=plan.head.receivers,
        resolution=plan.head.resolution,
    )


def check_before(plan: ImportPlan, *, progress: Progress | None = None) -> Verdict:
    """Return the verdict on the poses without making a store."""
    train = np.flatnonzero(plan.split == 0)
    chosen = train[np.linspace(0, len(train) - 1, min(MAX_PINGS, len(train))).round().astype(int)]
    part = replace(plan, pings=plan.pings[chosen], split=plan.split[chosen])
    with tempfile.TemporaryDirectory() as folder:
        return write_import(part, Path(folder) / "store", progress=progress)[1]


def describe_plan(plan: ImportPlan) -> list[str]:
    """Return the interpretation of the recordings, one line each."""
    settings, spectrogram = plan.settings, plan.settings.spectrogram
    poses = plan.poses[plan.pings]
    lower, upper = poses.positions.min(axis=0), poses.positions.max(axis=0)
    axis, frequency = plan.head.range, plan.head.frequency
    units = plan.recording.columns.units
    said = ", ".join(sorted({f"{kind} in {unit}" for kind, unit in _kinds(units).items()}))
    counts = np.bincount(plan.split, minlength=3)
    call = settings.call
    bands = ", ".join(f"{a / 1e3:g} to {b / 1e3:g} kHz" for a, b in call.bands.values())
    frame = "turntable" if plan.options.turntable is not None else plan.options.frame
    shortest, longest = (f"{1e3 * each:.4g}" for each in plan.lengths)
    lengths = f"{shortest} ms" if shortest == longest else f"{shortest} to {longest} ms"
    recording = plan.recording
    lines = [
        f"source:     {recording.path} ({plan.form}), {recording.sampling_rate:g} Hz",
        f"pings:      {len(recording)} read, {lengths} each, "
        f"{plan.clipped} clipped and rejected; "
        f"{counts[0]} train, {counts[1]} validation, {counts[2]} test",
        f"receivers:  {len(plan.head.receivers)}, {settings.ears.directivity}",
        f"poses:      frame {frame}{'; ' + said if said else ''}; x {lower[0]:.3f} to "
        f"{upper[0]:.3f}, y {lower[1]:.3f} to {upper[1]:.3f}, z {lower[2]:.3f} to "
        f"{upper[2]:.3f} m",
        f"call:       {call.kind}{', ' + bands if bands else ''}"
        f"{', by pulse compression' if plan.options.compress else ''}",
        f"air:        {plan.head.speed_of_sound:.1f} m/s",
        f"range:      {axis[0]:.3f} to {axis[-1]:.3f} m in {len(axis)} slices of "
        f"{1e3 * (axis[1] - axis[0]) if len(axis) > 1 else 0.0:.2f} mm",
        f"frequency:  {frequency[0] / 1e3:.1f} to {frequency[-1] / 1e3:.1f} kHz in "
        f"{len(frequency)} bins (window {spectrogram.window}, hop {spectrogram.hop}, fft "
        f"{spectrogram.fft})",
        _cost_line(plan),
        *(_channel_line(number, channel) for number, channel in enumerate(plan.channels)),
    ]
    here, there = (1e3 * head.resolution for head in (plan.head, plan.head.of_impulse()))
    if here > MIN_COMPRESSION_GAIN * there:
        lines.append(
            f"note:       ranges are resolved to {here:.0f} mm; import.compress=true resolves "
            f"them to {there:.0f} mm"
        )
    applied = {k: v for k, v in plan.calibration.items() if v not in (0.0, 1.0)}
    if applied:
        lines.append(f"calibration: {json.dumps(applied)}")
    faults = [f"warning:    {fault}" for fault in faults_of_channels(plan.channels)]
    return [*lines, *(f"note:       {note}" for note in plan.notes), *faults]


def _cost_line(plan: ImportPlan) -> str:
    """Show the size of the store and the duration of the import, measured on one ping."""
    begun = time.monotonic()
    heard = spectrogram_of(plan, int(plan.pings[0]))
    seconds = len(plan.pings) * (time.monotonic() - begun + WRITTEN_SECONDS)
    return (
        f"store:      {1e-6 * len(plan.pings) * heard.nbytes:,.0f} MB at most, in about "
        f"{duration(seconds)}"
    )


def _channel_line(number: int, channel: Channel) -> str:
    noise = "no noise"
    if np.isfinite(channel.noise_db):
        noise = f"noise {-channel.noise_db:.0f} dB below it"
    return (
        f"channel {number}:  loudest echo {channel.level_db + 0.0:.1f} dB, {noise}; echoes in "
        f"{channel.heard} of {channel.checked} pings"
    )


def _kinds(units: dict[str, str]) -> dict[str, str]:
    return {("angles" if unit in ("deg", "rad") else "lengths"): unit for unit in units.values()}


def draw_plan(plan: ImportPlan, folder: Path) -> Path:
    """Draw poses, and waveforms and spectrograms of the first pings, into a folder."""
    head = plan.head
    pings = [int(ping) for ping in plan.pings[:SHOWN_PINGS]]
    picture = pings_png(
        [plan.cutter.echo(ping, head.samples) for ping in pings],
        [spectrogram_of(plan, ping) for ping in pings],
        [plan.recording.labels[ping] for ping in pings],
        sampling_rate=plan.settings.spectrogram.sampling_rate,
        range_m=head.range,
        frequency_hz=head.frequency,
        poses=plan.poses[plan.pings],
    )
    storage.commit_bytes(folder / "pings.png", picture)
    return folder / "pings.png"
