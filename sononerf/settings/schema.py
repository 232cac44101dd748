# SPDX-License-Identifier: MIT
"""Typed settings: every name, its unit, its bounds, and the only home of its default.

Precedence: default < YAML file < ``KEY=VALUE`` < a named option of the command line.
SI units and radians inside; another unit is in the name.
"""

from __future__ import annotations

import difflib
from collections.abc import Mapping
from functools import cached_property
from pathlib import Path
from typing import Annotated, Any, Literal

from pydantic import Field, field_validator, model_validator

from sononerf.settings.sections import (
    CALL_PRESETS,
    Count,
    Decibels,
    Level,
    Name,
    PoseSettings,
    Positive,
    SceneSettings,
    Section,
    Seed,
    Spacing,
    SupportSettings,
    Vector,
    fft_of,
    hop_of,
    window_of,
)

HEAD_SECTIONS = ("air", "ears", "call", "spectrogram", "support")
"""Sections that describe the head: a store and an import state them."""
SPEED = 343.0
"""Speed of sound in air at 20 degrees, m/s."""
FILE_SECTIONS = ("ears", "call")
"""Sections whose key ``file`` names a file."""


class SimulationSettings(Section):
    """The echo simulator: accuracy, bounces, and the turn of the pattern of rays.

    The number of ``rays`` per pose is set, or as large as ``accuracy_db`` needs: that is the mean
    difference between two seeds over active cells, measured at a few poses before all are traced.
    The engine ``hybrid`` solves the wave equation of small bodies at low frequencies, with up to
    ``sources`` unknowns, and traces rays at high ones; ``rays`` traces rays alone.
    """

    engine: Literal["hybrid", "rays"] = "hybrid"
    accuracy_db: Annotated[float, Field(ge=0.01, le=10)] = 0.2
    rays: Annotated[int, Field(ge=100, le=100_000_000)] | None = None
    bounces: Annotated[int, Field(ge=1, le=10)] = 3
    sources: Annotated[int, Field(ge=10, le=20_000)] = 1000
    seed: Seed = 0
    noise_floor_poses: Annotated[int, Field(ge=0)] = 20

    @field_validator("engine", mode="before")
    @classmethod
    def _engine_is_there(cls, engine: object) -> object:
        if engine in ("kirchhoff", "spheres", "bem"):
            raise ValueError(f"{engine} was removed in version 0.2.0; take hybrid or rays")
        return engine


class AirSettings(Section):
    """The medium; the speed of sound is 343 m/s unless a temperature or the speed itself is set."""

    speed_of_sound: Annotated[float, Field(ge=100, le=10_000)] | None = None  # m/s
    temperature_c: Annotated[float, Field(ge=-20, le=50)] | None = None
    relative_humidity: Annotated[float, Field(ge=0, le=1)] = 0.5
    pressure_pa: Annotated[float, Field(ge=20_000, le=200_000)] = 101_325.0


class EarSettings(Section):
    """Emitter and receivers in the head frame (x forward, y left, z up).

    Two ears by default, at ``left`` and its mirror image. ``receivers`` gives other places, from
    one on. The directivity is that of a synthetic ear, of a circular piston of ``piston_radius``
    that looks ahead, the same in all directions, or measured: read from ``file``, with the
    receivers' places and the emitter's beam where it has them. A synthetic ear looks to its own
    side: ``azimuth_deg`` has the sign of its y, and is 0 where y is 0.
    """

    emitter: Vector = (0.0, 0.0, -0.010)
    left: Vector = (-0.010, 0.010, 0.005)  # the right ear is its mirror image
    receivers: Annotated[tuple[Vector, ...], Field(min_length=1, max_length=256)] | None = None
    directivity: Literal["ear", "omnidirectional", "piston", "file"] = "ear"
    piston_radius: Positive = 0.003
    file: Path | None = None
    beam_radius: Annotated[float, Field(ge=0)] = 0.003
    azimuth_deg: Annotated[float, Field(ge=-90, le=90)] = 25.0
    elevation_deg: Annotated[float, Field(ge=-90, le=90)] = 10.0
    width_deg: Annotated[float, Field(ge=5, le=180)] = 45.0
    notch_depth: Annotated[float, Field(ge=0, lt=1)] = 0.8

    @model_validator(mode="after")
    def _file_is_of_its_directivity(self) -> EarSettings:
        if self.directivity == "file" and self.file is None:
            raise ValueError("the directivity file needs ears.file")
        if self.directivity != "file" and self.file is not None:
            raise ValueError(
                f"file is of the directivity file, not of {self.directivity}; set directivity, or "
                "leave it out"
            )
        return self

    @property
    def is_directional(self) -> bool:
        """True if the gain of emitter or receivers depends on direction."""
        return self.directivity != "omnidirectional" or self.beam_radius > 0.0


class CallSettings(Section):
    """The emitted call: an impulse, a sweep of frequency with its harmonics, or a ``file``.

    A ``preset`` fills the other keys with those of a published call; keys that are also set
    override it. The file is a WAV of one channel that holds one call from the start of the emission
    on.
    """

    preset: str | None = None
    kind: Literal["impulse", "linear", "hyperbolic", "file"] = "impulse"
    file: Path | None = None
    duration: Annotated[float, Field(ge=1e-5, le=0.1)] = 0.4e-3
    frequency_start: Positive = 150e3
    frequency_end: Positive = 40e3
    harmonics: Annotated[tuple[Level, ...], Field(min_length=1, max_length=10)] = (1.0,)
    taper: Annotated[float, Field(ge=0, le=1)] = 0.1  # of the duration, half at either end

    @model_validator(mode="before")
    @classmethod
    def _preset_fills_what_is_not_set(cls, given: Any) -> Any:
        if not isinstance(given, Mapping) or given.get("preset") is None:
            return given
        name = given["preset"]
        if not isinstance(name, str) or name not in CALL_PRESETS:
            near = difflib.get_close_matches(str(name), CALL_PRESETS, n=1)
            hint = f"did you mean {near[0]}?" if near else f"known here: {', '.join(CALL_PRESETS)}"
            raise ValueError(f"preset: found {name!r}; {hint}")
        return {**CALL_PRESETS[name].keys, **given}

    @model_validator(mode="after")
    def _sweeps(self) -> CallSettings:
        if self.frequency_start == self.frequency_end:
            raise ValueError("frequency_start and frequency_end must differ")
        if not any(self.harmonics):
            raise ValueError("one of the harmonics at least must be above 0")
        if (self.file is None) == (self.kind == "file"):
            raise ValueError(
                "kind file needs file, the WAV of one call"
                if self.file is None
                else f"file is of the kind file, not of {self.kind}; set kind, or leave it out"
            )
        return self

    @property
    def bands(self) -> dict[int, tuple[float, float]]:
        """Lowest and highest frequency (Hz) of each harmonic that is emitted, of sweeps alone.

        Harmonics count from 1, the fundamental.
        """
        if self.kind in ("impulse", "file"):
            return {}
        low, high = sorted((self.frequency_start, self.frequency_end))
        return {h: (h * low, h * high) for h, a in enumerate(self.harmonics, start=1) if a > 0.0}


class SpectrogramSettings(Section):
    """The analysis: filters of equal or of growing width, a hop, and a crop in range.

    Of the kind ``stft`` a symmetric Hamming ``window`` and a padded ``fft``; of ``gammatone`` a
    bank of ``channels`` on a logarithmic frequency axis, each ``q`` times as high as it is wide.
    Where they are not set, window, hop and FFT follow from the band, and all of these and the band
    itself follow from a call that is not an impulse.
    """

    sampling_rate: Positive = 1e6
    frequency_min: Positive = 10e3
    frequency_max: Positive = 100e3
    window: Annotated[int, Field(ge=8)] = Field(default_factory=window_of)
    hop: Count = Field(default_factory=hop_of)
    fft: Annotated[int, Field(ge=8)] = Field(default_factory=fft_of)
    range_min: Positive = 0.15
    range_max: Positive = 0.75
    dynamic_range_db: Annotated[float, Field(gt=0, le=200)] = 60.0
    kind: Literal["stft", "gammatone"] = "stft"
    channels: Annotated[int, Field(ge=2, le=512)] = 48
    q: Annotated[float, Field(ge=1, le=50)] = 3.0  # centre over equivalent rectangular bandwidth

    @model_validator(mode="after")
    def _ordered(self) -> SpectrogramSettings:
        if self.frequency_min >= self.frequency_max:
            raise ValueError("frequency_min must lie below frequency_max")
        if self.frequency_max > self.sampling_rate / 2:
            raise ValueError(
                f"frequency_max is {self.frequency_max:g} Hz and must not exceed half the "
                f"sampling_rate of {self.sampling_rate:g} Hz; of recordings that were expanded in "
                "time, set the recorder's own rate (import.sampling_rate)"
            )
        if self.range_min >= self.range_max:
            raise ValueError("range_min must lie below range_max")
        wavelength = SPEED / self.frequency_max
        if wavelength > self.range_max:
            raise ValueError(
                f"frequency_max is {self.frequency_max:g} Hz, whose wavelength ({wavelength:.3g} m "
                f"in air) exceeds range_max ({self.range_max:g} m); are the frequencies in kHz? "
                "give Hz"
            )
        if self.fft < self.window:
            raise ValueError("fft must be at least window")
        return self


def check_call(call: CallSettings, spectrogram: SpectrogramSettings) -> None:
    """Refuse a sweep that the sampling rate cannot hold, or of which nothing is analysed."""
    bands, half = call.bands, spectrogram.sampling_rate / 2
    for number, (_, high) in bands.items():
        if high > half:
            raise ValueError(
                f"call: harmonic {number} reaches {high:g} Hz, above half of "
                f"spectrogram.sampling_rate ({half:g} Hz); lower the call's frequencies, leave "
                "the harmonic out (amplitude 0) or raise the rate"
            )
    low, high = spectrogram.frequency_min, spectrogram.frequency_max
    is_set = {"frequency_min", "frequency_max"} & spectrogram.model_fields_set
    if is_set and bands and not any(lo <= high and hi >= low for lo, hi in bands.values()):
        swept = ", ".join(f"{lo:g} to {hi:g} Hz" for lo, hi in bands.values())
        raise ValueError(
            f"call: sweeps {swept}, all outside spectrogram.frequency_min to frequency_max "
            f"({low:g} to {high:g} Hz); nothing would be heard"
        )


class NoiseSettings(Section):
    """White noise of the ears; ``sononerf.head.reception`` defines the ratio."""

    snr_db: Decibels | tuple[Decibels, Decibels] | None = None  # none, both ears, (left, right)
    relative_to: Literal["target", "pose"] = "target"
    target_strength_db: Decibels = -46.0  # of a rigid sphere 2 cm across
    target_distance: Positive = 0.4


class DataSettings(Section):
    """Place of the ensemble, and how it is streamed."""

    store: Path | None = None
    background: Literal["scene"] | Path | None = None  # taken off as power; scene: what it marks
    workers: Annotated[int, Field(ge=0, le=64)] = 0
    memory_bytes: Count = 2_000_000_000


class RegionSettings(Section):
    """The box that is fitted and read out; found from the echoes where it is not set."""

    lower: Vector | None = None
    upper: Vector | None = None

    @model_validator(mode="after")
    def _box(self) -> RegionSettings:
        if (self.lower is None) != (self.upper is None):
            raise ValueError("lower and upper are set together or not at all")
        if self.lower is not None and self.upper is not None:
            if not all(a < b for a, b in zip(self.lower, self.upper, strict=True)):
                raise ValueError("lower must lie below upper on every axis")
        return self


class FieldSettings(Section):
    """The reflectivity field by the name of its entry point, and the options of its factory."""

    kind: Name = "grid"
    options: dict[str, Any] = Field(default_factory=dict)


class RendererSettings(Section):
    """The renderer by the name of its entry point, and the options of its factory."""

    kind: Name = "profile"
    options: dict[str, Any] = Field(default_factory=dict)


class FitSettings(Section):
    """The fit: its length, its batches, its learning rate."""

    epochs: Count = 20
    steps_per_epoch: Annotated[int, Field(ge=1)] | Literal["auto"] = "auto"
    max_steps: Count | None = None
    batch_poses: Count = 6
    batch_slices: Count = 512
    batch_frequencies: Annotated[int, Field(ge=1)] | Literal["all"] = 6
    learning_rate: Positive | None = None  # the field's own where it is not set
    schedule: Literal["cool", "staircase"] = "cool"
    final_rate_factor: Annotated[float, Field(gt=0, le=1)] = 0.1
    staircase_factor: Annotated[float, Field(gt=0, le=1)] = 0.97
    staircase_epochs: Count = 20
    loss: Literal["l1", "l2", "l1_4l2"] = "l1"
    early_range_db: Annotated[float, Field(gt=0, le=200)] = 30.0  # second bounces lie below it
    early_share: Annotated[float, Field(ge=0, le=1)] = 0.75
    silent_weight: Annotated[float, Field(ge=0)] = 1.0
    silent_share: Annotated[float, Field(ge=0, le=1)] = 1.0  # of the slices in which nothing sounds
    gradient_clip: Positive | None = None
    seed: Seed = 0
    checkpoint_seconds: Positive = 60.0


class PreviewSettings(Section):
    """The coarse mesh and projections that each epoch leaves."""

    every_epochs: Count = 1
    voxels: Annotated[int, Field(ge=8, le=512)] = 48  # along the region's longest side


class PredictionSettings(Section):
    """Components of a prediction, beside the rendered field."""

    traced: Literal["auto", "off"] = "auto"  # echoes off the mesh, as far as validation bears out


class ReconstructionSettings(Section):
    """The surface of the echoes and the read-out of the finished field."""

    spacing: Spacing | None = None  # from the field's own resolution where it is not set
    level: Annotated[float, Field(ge=0)] | Literal["auto"] = "auto"  # of an iso-surface
    method: Literal["levels", "isosurface"] = "levels"
    refine: bool = True  # fit the surface to the echoes by physical optics
    directions: Annotated[int, Field(ge=6)] = 100
    smoothing: Annotated[float, Field(ge=0, le=1)] = 0.0  # side of a box over the volume, m

    @model_validator(mode="after")
    def _keys_of_an_isosurface(self) -> ReconstructionSettings:
        others = {"level": self.level != "auto", "smoothing": bool(self.smoothing)}
        for name, stands_alone in others.items():
            if stands_alone and self.method != "isosurface":
                raise ValueError(
                    f"{name} is of the method isosurface, not of {self.method}; set method, or "
                    "leave it out"
                )
        return self


class EvaluationSettings(Section):
    """The true surface that a reconstruction is compared with; metrics alone use it.

    Without ``truth`` it is the scene's own. A ``rigid`` registration turns and moves the result
    onto it, a ``similarity`` scales it too.
    """

    truth: Path | None = None
    unit: Literal["m", "cm", "mm"] = "m"  # of the numbers in the file of the truth
    frame: Literal["auto", "world", "original"] = "auto"  # of that file; auto: of the recordings
    registration: Literal["none", "rigid", "similarity"] = "none"


class Settings(Section):
    """One experiment, whole. Echoes come from a scene or from ``data.store``."""

    scene: SceneSettings | None = None
    poses: PoseSettings = PoseSettings()
    simulation: SimulationSettings = SimulationSettings()
    air: AirSettings = AirSettings()
    ears: EarSettings = EarSettings()
    call: CallSettings = CallSettings()
    spectrogram: SpectrogramSettings = SpectrogramSettings()
    support: SupportSettings = SupportSettings()
    noise: NoiseSettings = NoiseSettings()
    data: DataSettings = DataSettings()
    region: RegionSettings = RegionSettings()
    field: FieldSettings = FieldSettings()
    renderer: RendererSettings = RendererSettings()
    fit: FitSettings = FitSettings()
    preview: PreviewSettings = PreviewSettings()
    prediction: PredictionSettings = PredictionSettings()
    reconstruction: ReconstructionSettings = ReconstructionSettings()
    evaluation: EvaluationSettings = EvaluationSettings()

    @model_validator(mode="after")
    def _echoes_come_from_somewhere(self) -> Settings:
        if self.scene is None and self.data.store is None:
            raise ValueError("scene: missing; set scene.name, or data.store for recorded echoes")
        return self

    @model_validator(mode="after")
    def _noise_is_of_each_receiver(self) -> Settings:
        places, level = self.ears.receivers, self.noise.snr_db
        if places is not None and len(places) != 2 and isinstance(level, tuple):
            raise ValueError(
                f"noise.snr_db: gives 2 levels for {len(places)} ears.receivers; give one level "
                "for all"
            )
        return self

    @model_validator(mode="after")
    def _call_is_sampled_and_heard(self) -> Settings:
        check_call(self.call, self.spectrogram)
        return self

    @model_validator(mode="after")
    def _head_is_smaller_than_its_ranges(self) -> Settings:
        ears, limit = self.ears, self.spectrogram.range_max
        lengths = {
            "emitter": max(map(abs, ears.emitter)),
            "left": max(map(abs, ears.left)),
            "receivers": max(abs(part) for place in ears.receivers or [(0.0,)] for part in place),
            "piston_radius": ears.piston_radius,
            "beam_radius": ears.beam_radius,
        }
        for name, length in lengths.items():
            if length > limit:
                raise ValueError(
                    f"ears.{name}: {length:g} m exceeds spectrogram.range_max ({limit:g} m); is it "
                    "in mm? give metres"
                )
        return self

    @cached_property
    def source(self) -> str | None:
        """The file they were read from, for messages; no part of the settings, nor compared."""
        return None

    def plain(self) -> dict[str, Any]:
        """Return the settings as plain data, ready for YAML, JSON and checkpoints."""
        return self.model_dump(mode="json")
