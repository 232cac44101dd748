# SPDX-License-Identifier: MIT
"""Settings of an import, beside air, ears, call and analysis."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Annotated, Any, Literal

from pydantic import Field, ValidationError, model_validator

from sononerf.errors import SettingsError
from sononerf.settings.loading import describe_faults
from sononerf.settings.section import Positive, Section, Seed, Vector

Matrix = tuple[Vector, Vector, Vector]
Channels = Annotated[
    tuple[Annotated[int, Field(ge=0)] | tuple[Annotated[int, Field(ge=0)], ...], ...],
    Field(min_length=1, max_length=256),
]
LENGTHS = {"m": 1.0, "cm": 0.01, "mm": 0.001}
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
    length: Literal["m", "cm", "mm"] | None = None
    angle: Literal["deg", "rad"] | None = None
    frame: Literal["enu", "ned", "camera", "own"] = "enu"
    axes: Matrix | None = None
    head_axes: Matrix | None = None
    positive_pitch: Literal["down", "up"] | None = None
    quaternion: Literal["wxyz", "xyzw"] | None = None
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


def read_import_settings(data: Mapping[str, Any], where: str) -> ImportSettings:
    """Check the section ``import`` of a settings file."""
    if not isinstance(data, Mapping):
        raise SettingsError(f"{where}: import: holds {data!r}, expected `key: value` lines")
    try:
        return ImportSettings.model_validate(dict(data))
    except ValidationError as error:
        text = describe_faults(error, ImportSettings, where, prefix="import")
        raise SettingsError(text) from None
