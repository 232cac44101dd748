# SPDX-License-Identifier: MIT
"""Sections of settings: their base, scene, support, poses, calls, and those of an import."""

from __future__ import annotations

import math
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any, Literal

from pydantic import BaseModel, ConfigDict, Field, model_validator

Vector = tuple[float, float, float]
Name = Annotated[str, Field(min_length=1)]
Positive = Annotated[float, Field(gt=0)]
Spacing = Annotated[float, Field(gt=0, le=0.1)]  # m; more were millimetres taken for metres
Level = Annotated[float, Field(ge=0)]
Decibels = Annotated[float, Field(ge=-100, le=200)]
Count = Annotated[int, Field(ge=1)]
Seed = Annotated[int, Field(ge=0, lt=2**32)]


class Section(BaseModel):
    """A section of settings: no unknown keys, frozen, finite numbers only."""

    model_config = ConfigDict(
        extra="forbid", frozen=True, validate_default=True, allow_inf_nan=False
    )


@dataclass(frozen=True)
class CallPreset:
    """A call."""

    keys: dict[str, Any]  # Keys of the section ``call``, with their values
    about: str  # One line: whose call, and when it is emitted
    source: str  # Publications, and which numbers are typical values only


CALL_PRESETS = {
    "eptesicus_fuscus": CallPreset(
        {
            "kind": "hyperbolic",
            "duration": 2.3e-3,
            "frequency_start": 75e3,
            "frequency_end": 33e3,
            "harmonics": (1.0, 0.5),
        },
        "big brown bat, leaving the roost: two harmonics, the fundamental from 75 to 33 kHz",
        "A. Rodriguez and E. C. Mora, Caribbean Journal of Science 42(1):121-128, 2006: duration, "
        "frequencies, two harmonics. Hyperbolic: R. A. Altes and E. L. Titlebaum, Journal of the "
        "Acoustical Society of America 48:1014-1020, 1970. The second harmonic's amplitude is "
        "typical.",
    ),
    "phyllops_falcatus": CallPreset(
        {
            "kind": "hyperbolic",
            "duration": 2e-3,
            "frequency_start": 73e3,
            "frequency_end": 23e3,
            "harmonics": (1.0, 1.0, 0.5),
        },
        "Cuban fig-eating bat, near bushes: three harmonics, the fundamental from 73 to 23 kHz",
        "S. Macias, E. C. Mora, C. Koch and O. von Helversen, Acta Chiropterologica 7(2):275-283, "
        "2005: duration (1 ms or less close to a fruit, 4.5 ms in free flight), frequencies, "
        "harmonics. Hyperbolic, and the harmonics' amplitudes, are typical.",
    ),
    "micronycteris_microtis": CallPreset(
        {
            "kind": "hyperbolic",
            "duration": 0.5e-3,
            "frequency_start": 55e3,
            "frequency_end": 33e3,
            "harmonics": (0.3, 1.0, 0.5),
        },
        "common big-eared bat, gleaning from leaves: three harmonics, the loudest 110 to 66 kHz",
        "I. Geipel, K. Jung and E. K. V. Kalko, Proceedings of the Royal Society B 280:20122830, "
        "2013: short, of several harmonics and broad. All numbers are typical.",
    ),
    "fm_1ms": CallPreset(
        {"kind": "linear", "duration": 1e-3, "frequency_start": 90e3, "frequency_end": 30e3},
        "a straight sweep from 90 to 30 kHz in a millisecond",
        "H.-U. Schnitzler and E. K. V. Kalko, BioScience 51(7):557-569, 2001, on sweeps near "
        "obstacles. Of no species; all numbers are typical.",
    ),
    "fm_3ms": CallPreset(
        {"kind": "linear", "duration": 3e-3, "frequency_start": 90e3, "frequency_end": 30e3},
        "a straight sweep from 90 to 30 kHz in three milliseconds",
        "H.-U. Schnitzler and E. K. V. Kalko, BioScience 51(7):557-569, 2001, on sweeps of bats "
        "that search. Of no species; all numbers are typical.",
    ),
    "rhinolophus_fm": CallPreset(
        {"kind": "linear", "duration": 0.87e-3, "frequency_start": 83e3, "frequency_end": 63e3},
        "greater horseshoe bat, the sweep that ends the call; its constant tone tells no range",
        "M. M. Andrews et al., Acta Chiropterologica 8(1):197-212, 2006: 83 kHz. B. Vogler and "
        "G. Neuweiler, Journal of Comparative Physiology A 152:421-432, 1983: 12 to 20 kHz wide. "
        "B. Tian and H.-U. Schnitzler, Journal of the Acoustical Society of America 101:2347-2364, "
        "1997: so short that it does not overlap its echo from 15 cm on, which is 0.87 ms. The "
        "straight sweep is typical.",
    ),
    "sonotracelab": CallPreset(
        {
            "kind": "hyperbolic",
            "duration": 0.4e-3,
            "frequency_start": 150e3,
            "frequency_end": 40e3,
            "taper": 0.1,
        },
        "the sweep in the examples of the simulator SonoTraceLab: from 150 to 40 kHz in 0.4 ms",
        "W. Jansen and J. Steckel, SonoTraceLab, IEEE Access 12, 2024.",
    ),
    "airsas": CallPreset(
        {"kind": "linear", "duration": 1e-3, "frequency_start": 30e3, "frequency_end": 10e3},
        "an in-air synthetic aperture sonar: a straight sweep from 30 to 10 kHz in a millisecond",
        "A. Reed et al., Neural Volumetric Reconstruction for Coherent Synthetic Aperture Sonar, "
        "ACM Transactions on Graphics 42(4), 2023; direction and duration as in the waveform that "
        "its authors publish.",
    ),
}
"""By the name that ``call.preset`` takes."""


def window_of(spectrogram: dict[str, Any]) -> int:
    """Return the power of two, in samples, that is nearest to 6.4 periods of the highest frequency.

    It gives 64 at 1 MHz for up to 100 kHz.
    """
    if not {"sampling_rate", "frequency_max"} <= spectrogram.keys():  # another check reports it
        return 64
    periods = 6.4 * spectrogram["sampling_rate"] / spectrogram["frequency_max"]
    return int(2 ** max(round(math.log2(periods)), 3))


def hop_of(spectrogram: dict[str, Any]) -> int:
    """Return a sixteenth of the window that suits the band, in samples."""
    return max(window_of(spectrogram) // 16, 1)


def fft_of(spectrogram: dict[str, Any]) -> int:
    """Return eight times the window that suits the band, and more if a longer one is set."""
    longest = max(8 * window_of(spectrogram), spectrogram.get("window", 8))
    return int(2 ** math.ceil(math.log2(longest)))


class SceneSettings(Section):
    """The ensonified scene: its name, and the options of its factory."""

    name: Name
    options: dict[str, Any] = Field(default_factory=dict)


class SupportSettings(Section):
    """A large rigid plane under the body, such as a table or a turntable; none by default.

    It mirrors sound. ``point`` (m, world frame) lies on it, ``normal`` points to the side of body
    and head. Its own echo is not included: recordings with the support have a recording of the
    support alone subtracted.
    """

    point: Vector | None = None
    normal: Vector = (0.0, 0.0, 1.0)

    @model_validator(mode="after")
    def _has_a_side(self) -> SupportSettings:
        if not 1e-6 <= max(abs(part) for part in self.normal) <= 1e6:
            raise ValueError("normal gives no direction; expected one such as [0, 0, 1]")
        return self


class PoseSettings(Section):
    """Poses of the calls; validation and test poses are drawn apart from the training poses.

    On a ``sphere`` about the origin, on a ``cap`` of it about an axis, in a ``volume`` between
    two radii (within the cap, where an angle is set), on a ``cylinder`` about the z axis between
    two heights (they look level at the axis), or along a ``path``: the rows of a table
    ``x,y,z,yaw,pitch,roll``, of which some are drawn for validation and test; number, radius, axis
    and jitter do not apply to it.
    """

    arrangement: Literal["sphere", "cap", "volume", "cylinder", "path"] = "sphere"
    count: Count = 400
    validation: Annotated[int, Field(ge=0)] = 10
    heldout: Annotated[int, Field(ge=0)] = 20
    radius: Positive = 0.4
    radius_max: Positive | None = None
    axis: Vector = (1.0, 0.0, 0.0)
    half_angle_deg: Annotated[float, Field(gt=0, le=180)] | None = None
    heights: tuple[float, float] | None = None  # m
    path: Path | None = None
    aim_jitter_deg: Annotated[float, Field(ge=0, le=90)] = 15.0
    seed: Seed = 0

    @model_validator(mode="after")
    def _arranged(self) -> PoseSettings:
        for name, needed, allowed in (
            ("half_angle_deg", "cap", ("cap", "volume")),
            ("radius_max", "volume", ("volume",)),
            ("heights", "cylinder", ("cylinder",)),
            ("path", "path", ("path",)),
        ):
            there = getattr(self, name) is not None
            if there and self.arrangement not in allowed:
                where = " or ".join(allowed)
                fault = f"{name} is of the arrangement {where}, not of {self.arrangement}"
                raise ValueError(f"{fault}; set arrangement, or leave it out")
            if not there and self.arrangement == needed:
                raise ValueError(f"the arrangement {needed} needs {name}")
        if not 1e-6 <= max(abs(part) for part in self.axis) <= 1e6:
            raise ValueError("axis gives no direction; expected one such as [1, 0, 0]")
        if self.radius_max is not None and self.radius >= self.radius_max:
            raise ValueError("radius must lie below radius_max")
        if self.heights is not None and self.heights[0] > self.heights[1]:
            raise ValueError("heights must be the lowest and the highest")
        return self


Matrix = tuple[Vector, Vector, Vector]
Channels = Annotated[
    tuple[Annotated[int, Field(ge=0)] | tuple[Annotated[int, Field(ge=0)], ...], ...],
    Field(min_length=1, max_length=256),
]
LENGTHS = {"m": 1.0, "cm": 0.01, "mm": 0.001, "in": 0.0254, "ft": 0.3048}
"""Units of length by name, m."""
SPLIT_SEED = 0


class TurntableSettings(Section):
    """A fixed sensor and an object that turns about a vertical axis, the world's z.

    The sensor stands ``radius`` (m) from the axis and looks at it, level. ``turns`` is the sense
    in which growing angles turn the object, seen from above. ``height`` (m) is added to the
    heights of the table. ``surface`` (m, world frame) is the height of the plate that the object
    stands on: it becomes ``support.point``. Without it the plate is taken as silent.
    """

    radius: Positive
    turns: Literal["counterclockwise", "clockwise"] = "counterclockwise"
    height: float = 0.0
    surface: float | None = None


class ReferenceSettings(Section):
    """A recording of a rigid sphere straight ahead of the head, for calibration.

    ``distance`` (m) is measured from the emitter to the nearest point of the sphere, ``radius``
    (m) is the sphere's. The call of the recording is emitted at ``time`` (s) of the file.
    """

    file: Path
    radius: Positive
    distance: Positive
    time: float = 0.0


class ImportSettings(Section):
    """Format of recordings and poses; paths are relative to the folder of the source.

    Units have no default: the names of columns say them (``x_mm``, ``yaw_deg``), or ``length`` and
    ``angle`` do.
    """

    # Poses.
    poses: Path = Path("poses.csv")
    length: Literal["m", "cm", "mm", "in", "ft"] | None = None
    angle: Literal["deg", "rad"] | None = None
    frame: Literal["enu", "ned", "camera", "own"] = "enu"
    axes: Matrix | None = None
    head_axes: Matrix | None = None
    positive_pitch: Literal["down", "up"] | None = None
    # Order of the matrices of yaw (z), pitch (y) and roll (x)
    euler: Literal["zyx", "xyz"] = "zyx"
    quaternion: Literal["wxyz", "xyzw"] | None = None
    # What leads from the world to the head: the rotations alone, or all of the poses
    inverse: Literal["rotations", "poses"] | None = None
    look_at: Vector | None = None
    turntable: TurntableSettings | None = None
    # Recordings.
    file: Path | None = None
    sampling_rate: Positive | None = None
    channels: Channels | None = None
    time_offset: float = 0.0  # s, added to the time of every emission
    missing: Literal["refuse", "skip"] = "refuse"
    reject_clipped: bool = True
    # Calibration.
    scale: Positive = 1.0
    range_offset: float = 0.0  # m, added to every range
    reference: ReferenceSettings | None = None
    background: Path | None = None
    background_time: float = 0.0  # s, of the emission in the background recording
    compress: bool = False  # echoes of the call become those of an impulse
    # What becomes of it.
    validation: Annotated[int, Field(ge=0)] | None = None
    heldout: Annotated[int, Field(ge=0)] | None = None
    seed: Seed = SPLIT_SEED
    source: str | None = None
    licence: str | None = None

    @model_validator(mode="after")
    def _own_axes(self) -> ImportSettings:
        if (self.axes is not None) != (self.frame == "own"):
            raise ValueError("axes and frame=own go together: give both or neither")
        if self.head_axes is not None and self.frame != "own":
            raise ValueError("head_axes is of frame=own; set it, or leave head_axes out")
        return self
