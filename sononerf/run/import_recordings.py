# SPDX-License-Identifier: MIT
"""From recordings to a sealed ensemble of echoes."""

from __future__ import annotations

import hashlib
import json
import logging
import tempfile
import time
from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from sononerf import __version__, storage
from sononerf.echoes.detection import seal_recorded
from sononerf.echoes.echoes import Echoes
from sononerf.echoes.store import EnsembleStore
from sononerf.errors import IncompatibleError
from sononerf.head.call import attach
from sononerf.head.reception import warn_of_call
from sononerf.numerics import Singles
from sononerf.progress import Progress, duration
from sononerf.recordings.pose_check import MAX_PINGS, Verdict, alternatives, check_poses, shifted
from sononerf.recordings.pose_tables import original_frame
from sononerf.recordings.recording import Channel, faults_of_channels
from sononerf.report.spectrogram_picture import pings_png
from sononerf.run.import_plan import ImportPlan, plan_import
from sononerf.settings.loading import assignments
from sononerf.settings.schema import HEAD_SECTIONS, CallSettings

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
        settings_file: Settings of the import; ``import.yaml`` beside the recordings where None.
        progress: Display of progress; on stderr where None.

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
        if store.attributes.get("import_hash") != echoes_id:
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
        "import_hash": echoes_id,
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
    of_impulse = replace(plan.head, call=CallSettings())
    here, there = (1e3 * head.resolution for head in (plan.head, of_impulse))
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
