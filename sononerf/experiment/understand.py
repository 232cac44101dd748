# SPDX-License-Identifier: MIT
"""What recordings and settings say together, before anything is written."""

from __future__ import annotations

from collections.abc import Callable, Iterable
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from sononerf.acoustics.air import absorption_in, speed_in
from sononerf.acoustics.ears import Ears, synthetic_ears
from sononerf.acoustics.reception import Reception
from sononerf.acoustics.spectrogram import echo_samples, frequency_axis, range_axis
from sononerf.config import Settings, apply_override, read_yaml, validate_settings
from sononerf.echoes.detection import RANK
from sononerf.echoes.extent import echo_extent
from sononerf.echoes.onsets import PointEcho
from sononerf.errors import InputError, SettingsError
from sononerf.geometry.poses import Poses
from sononerf.recordings.airsas import read_airsas
from sononerf.recordings.arrays import read_numpy
from sononerf.recordings.conventions import to_poses
from sononerf.recordings.folder import read_folder, read_sound
from sononerf.recordings.pings import Cutter, check_numbers, clipped_pings, cut, mix
from sononerf.recordings.recording import Recording
from sononerf.recordings.reference import calibrate
from sononerf.recordings.settings import ImportSettings, read_import_settings
from sononerf.recordings.sonotrace import read_sononerf_matlab, read_sonotracelab
from sononerf.recordings.splits import assign_split

Array = NDArray[np.float64]

READERS: dict[str, Callable[[Path, ImportSettings], Recording]] = {
    "recordings": read_folder,
    "numpy": read_numpy,
    "sonotracelab": read_sonotracelab,
    "sononerf-matlab": read_sononerf_matlab,
    "airsas": read_airsas,
}
SECTIONS = ("air", "ears", "call", "spectrogram")
OWN_SETTINGS = "import.yaml"
ASKED = 64
"""So many pings, evenly over all, are asked for ranges and noise."""
WIDER = 1e-9  # m; so that the last frame is not lost to rounding


@dataclass(frozen=True, eq=False)
class Understood:
    """All that an import knows.

    Attributes
    ----------
    form : str
        Format of the source.
    recording : Recording
        All pings that were read.
    settings : Settings
        Air, ears, call and analysis, complete.
    wanted : ImportSettings
        How it was read.
    cutter : Cutter
        Cuts and calibrates pings.
    ears : Ears
        Places of emitter and receivers.
    pings : (P,) int
        Which of the recording's pings are kept.
    poses : Poses
        Of all pings of the recording.
    split : (P,) int8
        Of the kept pings.
    clipped : int
        How many pings are rejected.
    level_db : float, dB
        Loudest echo over the noise, power averaged over frequency; the middle ping of those asked.
    calibration : dict
        What was applied, as plain data.
    notes : tuple of str
        What may surprise.
    """

    form: str
    recording: Recording
    settings: Settings
    wanted: ImportSettings
    cutter: Cutter
    ears: Ears
    pings: NDArray[np.int64]
    poses: Poses
    split: NDArray[np.int8]
    clipped: int
    level_db: float
    calibration: dict[str, Any]
    notes: tuple[str, ...]

    @property
    def reception(self) -> Reception:
        """Call and analysis."""
        settings = self.settings
        return _reception(settings)

    @property
    def speed_of_sound(self) -> float:
        """Of the air, m/s."""
        return speed_in(self.settings.air)


def understand(
    form: str,
    source: Path,
    output: Path,
    *,
    settings_file: Path | None = None,
    overrides: Iterable[str] = (),
) -> Understood:
    """Read recordings and settings, and complete each by the other.

    Parameters
    ----------
    form : str
        A name of :data:`READERS`.
    source : Path
        File or folder.
    output : Path
        The store to be.
    settings_file : Path or None
        Sections ``import``, ``air``, ``ears``, ``call``, ``spectrogram``; ``import.yaml`` beside
        the recordings where None, if it is there.
    overrides : iterable of str
        ``KEY=VALUE``.

    Raises
    ------
    SettingsError
        If a key or value is not allowed, or settings and recordings contradict one another.
    InputError
        If recordings or poses are no good.
    """
    if form not in READERS:
        raise SettingsError(f"unknown format {form!r}; known: {', '.join(READERS)}")
    if not source.exists():
        raise InputError(f"{source}: no such file or folder")
    if form != "recordings" and source.is_dir():
        raise InputError(f"{source}: is a folder; the format {form} is one file")
    folder = source if source.is_dir() else source.parent
    where, data = _settings_data(folder, settings_file, overrides)
    wanted = read_import_settings(data.pop("import", None) or {}, where)
    recording = READERS[form](source, wanted)
    settings = _complete(data, recording, wanted, output, where)
    ears = synthetic_ears(settings.ears, frequency_axis(settings.spectrogram))
    places = settings.ears.receivers
    receivers = len(ears.positions) if places is None else len(places)
    heard = len(mix(np.zeros((recording.read(0).shape[0], 1)), wanted.channels))
    if heard != receivers:
        raise InputError(
            f"{recording.path}: {heard} channels, and the settings describe {receivers} "
            "receivers; set ears.receivers to one place for each channel, or choose channels with "
            "import.channels"
        )
    poses = to_poses(recording.columns, wanted)
    if len(poses) != len(recording):
        raise InputError(f"{recording.path}: {len(recording)} pings and {len(poses)} poses")
    cutter, calibration = _calibrated(recording, wanted, settings, ears, folder)
    check_numbers(recording, cutter, 0)
    settings, power = _ranges(settings, cutter, recording, data)
    check_numbers(recording, cutter, _reception(settings).samples)
    kept, clipped = _without_clipped(recording, cutter, settings, wanted)
    split = assign_split(
        poses[kept],
        recording.columns.take(kept).split(),
        validation=wanted.validation,
        heldout=wanted.heldout,
        seed=wanted.seed,
        where=str(recording.path),
    )
    noise = np.quantile(power, RANK, axis=-1)
    ratio = power.max(axis=-1) / np.maximum(noise, 1e-300)
    return Understood(
        form=form,
        recording=recording,
        settings=settings,
        wanted=wanted,
        cutter=cutter,
        ears=ears,
        pings=kept,
        poses=poses,
        split=split,
        clipped=clipped,
        level_db=float(10.0 * np.log10(max(np.median(ratio), 1e-30))),
        calibration=calibration,
        notes=recording.notes,
    )


def _reception(settings: Settings) -> Reception:
    speed = speed_in(settings.air)
    return Reception(settings.call, settings.spectrogram, settings.noise, speed_of_sound=speed)


def _settings_data(
    folder: Path, settings_file: Path | None, overrides: Iterable[str]
) -> tuple[str, dict[str, Any]]:
    if settings_file is None and (folder / OWN_SETTINGS).is_file():
        settings_file = folder / OWN_SETTINGS
    data = {} if settings_file is None else read_yaml(settings_file)
    for assignment in overrides:
        apply_override(data, assignment)
    where = "command line" if settings_file is None else str(settings_file)
    unknown = [name for name in data if name not in (*SECTIONS, "import")]
    if unknown:
        raise SettingsError(
            f"{where}: {unknown[0]}: no section of an import; known: import, {', '.join(SECTIONS)}"
        )
    return where, data


def _complete(
    data: dict[str, Any],
    recording: Recording,
    wanted: ImportSettings,
    output: Path,
    where: str,
) -> Settings:
    """Fill what the settings leave out from the recording, and check them as those of a fit."""
    for section, known in recording.settings.items():
        own = data.setdefault(section, {})
        if isinstance(own, dict):
            data[section] = {**_mixed(known, wanted), **own}
    analysis = data.setdefault("spectrogram", {})
    if isinstance(analysis, dict):
        rate = analysis.setdefault("sampling_rate", recording.sampling_rate)
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


def _mixed(known: dict[str, Any], wanted: ImportSettings) -> dict[str, Any]:
    """Return what the source says of receivers, for the channels that are chosen."""
    if "receivers" not in known or wanted.channels is None:
        return known
    places = mix(np.asarray(known["receivers"], dtype=np.float64), wanted.channels)
    return {**known, "receivers": places.tolist()}


def _calibrated(
    recording: Recording,
    wanted: ImportSettings,
    settings: Settings,
    ears: Ears,
    folder: Path,
) -> tuple[Cutter, dict[str, Any]]:
    """Return what cuts pings, with background, reference and offsets, and what was applied."""
    speed, rate = speed_in(settings.air), recording.sampling_rate
    applied: dict[str, Any] = {
        "scale": wanted.scale,
        "time_offset_s": wanted.time_offset,
        "range_offset_m": wanted.range_offset,
    }
    # An echo from farther away comes later; the emission is moved the other way.
    delay = wanted.time_offset - 2.0 * wanted.range_offset / speed
    cutter = Cutter(recording, wanted.channels, delay, wanted.scale)
    if wanted.background is not None:
        quiet = _beside(folder / wanted.background, recording, wanted)
        begin = wanted.background_time + delay
        background = cut(quiet, begin * rate, quiet.shape[1] - int(begin * rate))
        cutter = replace(cutter, background=background)
        applied["background"] = wanted.background.name
    if wanted.reference is not None:
        target = wanted.reference
        heard = _beside(folder / target.file, recording, wanted)
        begin = (target.time + delay) * rate
        echo = cut(heard, begin, heard.shape[1] - int(begin))
        if cutter.background is not None:
            size = min(echo.shape[1], cutter.background.shape[1])
            echo[:, :size] -= cutter.background[:, :size]
        found = calibrate(
            mix(echo, wanted.channels) * wanted.scale,
            target,
            ears=ears,
            call=settings.call,
            analysis=settings.spectrogram,
            absorption=absorption_in(settings.air, frequency_axis(settings.spectrogram)),
            speed_of_sound=speed,
        )
        delay -= 2.0 * found.range_offset / speed
        cutter = replace(cutter, delay=delay, gain=wanted.scale * found.gain)
        if cutter.background is not None:
            begin = wanted.background_time + delay
            background = cut(quiet, begin * rate, quiet.shape[1] - int(begin * rate))
            cutter = replace(cutter, background=background)
        applied["reference"] = {
            "file": target.file.name,
            "gain_db": np.round(20.0 * np.log10(found.gain), 3).tolist(),
            "range_offset_m": round(found.range_offset, 6),
        }
    return cutter, applied


def _beside(path: Path, recording: Recording, wanted: ImportSettings) -> NDArray[Any]:
    """Read another recording of the same rate and channels."""
    rate, samples = read_sound(path, wanted)
    channels = recording.read(0).shape[0]
    if rate != recording.sampling_rate or len(samples) != channels:
        raise InputError(
            f"{path}: {len(samples)} channels at {rate:g} Hz, the pings have {channels} at "
            f"{recording.sampling_rate:g} Hz; all must have the same"
        )
    return samples


def _ranges(
    settings: Settings, cutter: Cutter, recording: Recording, data: dict[str, Any]
) -> tuple[Settings, Array]:
    """Set range limits that are left out from the echoes; return the power over range too."""
    analysis, speed = settings.spectrogram, speed_in(settings.air)
    rate = analysis.sampling_rate
    count = min(cutter.samples(index) for index in range(len(recording)))
    begins = max(cutter.begins(index) for index in range(len(recording)))
    metre = speed / 2.0 / rate  # of a sample
    longest = float(_reception(settings).delay.max())
    whole = _widest(analysis.window, count, longest * rate, metre)
    emitter = np.asarray(settings.ears.emitter)
    places = settings.ears.receivers
    apart = np.linalg.norm(
        np.asarray([settings.ears.left] if places is None else places) - emitter, axis=1
    )
    # The call itself comes first, as long as a window smears it.
    dead = float(apart.max()) / 2.0 + 2.0 * analysis.window * metre
    first = max(dead, (begins + analysis.window / 2.0) * metre)
    given = data.get("spectrogram", {})
    low = analysis.range_min if "range_min" in given else first
    high = analysis.range_max if "range_max" in given else whole
    if low < (begins + (analysis.window - 1) / 2.0) * metre - metre:
        raise InputError(
            f"{recording.path}: a recording begins after spectrogram.range_min ({low:g} m); raise "
            "it, or leave it out"
        )
    if not low < high:
        raise InputError(
            f"{recording.path}: the recordings end {whole:.3g} m after the emission, before "
            f"anything can be heard from {low:.3g} m on; check column time and its unit"
        )
    chosen = {"range_min": low, "range_max": high}
    wide = settings.model_copy(
        update={"spectrogram": analysis.model_copy(update={**chosen})}, deep=False
    )
    reception = _reception(wide)
    if reception.samples > count:
        raise InputError(
            f"{recording.path}: the recordings end {whole:.4g} m after the emission, before "
            f"spectrogram.range_max ({high:g} m); lower it, or leave it out"
        )
    pings = np.linspace(0, len(recording) - 1, min(ASKED, len(recording))).round().astype(int)
    power = np.stack(
        [
            np.square(reception.analyse(cutter.echo(int(i), reception.samples))).mean(axis=-1)
            for i in np.unique(pings)
        ]
    )
    echo = PointEcho.of(settings.call, analysis, speed)
    axis = range_axis(wide.spectrogram, speed)
    found = echo_extent(power, axis, echo.looks, 2.0 * echo.resolution)
    limits = {
        "range_min": low if "range_min" in given else round(found[0], 4),
        "range_max": high if "range_max" in given else round(found[1], 4),
    }
    plain = settings.plain()
    plain["spectrogram"] |= limits
    return validate_settings(plain, settings.source or "import"), power


def _widest(window: int, count: int, delay: float, metre: float) -> float:
    """Return the greatest range (m) whose frame lies in so many samples."""
    return (count - np.ceil(delay) - 1.0 - window / 2.0) * metre


def _without_clipped(
    recording: Recording, cutter: Cutter, settings: Settings, wanted: ImportSettings
) -> tuple[NDArray[np.int64], int]:
    """Return the pings to keep, and how many are clipped where their echoes are."""
    if not wanted.reject_clipped:
        return np.arange(len(recording)), 0
    analysis, speed = settings.spectrogram, speed_in(settings.air)
    first = int(analysis.range_min * 2.0 / speed * analysis.sampling_rate - analysis.window / 2.0)
    last = echo_samples(analysis, speed)
    found = [cutter.clipped(index, max(first, 0), last) for index in range(len(recording))]
    bad = clipped_pings(found)
    if bad.all():
        raise InputError(
            f"{recording.path}: all {len(bad)} pings are clipped where echoes are; record with "
            "less gain, or set import.reject_clipped=false"
        )
    return np.flatnonzero(~bad), int(bad.sum())
