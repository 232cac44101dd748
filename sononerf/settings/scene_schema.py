# SPDX-License-Identifier: MIT
"""Settings of scene, support and poses."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Any, Literal

from pydantic import Field, model_validator

from sononerf.settings.section import Count, Name, Positive, Section, Seed, Vector


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
