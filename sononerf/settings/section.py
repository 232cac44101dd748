# SPDX-License-Identifier: MIT
"""Base of all sections of settings: their strictness, and types with bounds."""

from __future__ import annotations

from typing import Annotated

from pydantic import BaseModel, ConfigDict, Field

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
