# SPDX-License-Identifier: MIT
"""Result of a refinement."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import trimesh

from sononerf.array_types import Floats
from sononerf.surface.start.read_out import StartMethod


@dataclass(frozen=True, eq=False)
class Refined:
    """A refined surface.

    Attributes:
        mesh: m.
        gain (E, F): Factor of rendered magnitudes, learned on training poses.
        confidence (V,): Number of training poses that see each vertex near the direction of a
            mirror; 0 where echoes do not bound its place.
        error ((V,), m): See :mod:`sononerf.surface.refine.surface_error`.
        start: Name of the start that was refined.
        kept: True where the refined surface explains the validation poses about as well as the
            start, or better.
        error_db: Objective on validation poses, see
            :class:`~sononerf.surface.refine.comparison.Comparison`.
        history: Per stage: its number, start, way, last mismatch, and objective after it.
        candidates: Per start: its name, its objective, that of its best surface (None where it
            did not get beyond the first stage), and whether it was chosen.
        faults: Faults of the refinement, one line each: a surface that could not be traced and
            counted as the worst, or a stage that went without the simulator's correction.
    """

    mesh: trimesh.Trimesh
    gain: Floats
    confidence: Floats
    error: Floats
    start: StartMethod
    kept: bool
    error_db: float
    history: list[dict[str, Any]]
    faults: list[str]
    candidates: list[dict[str, Any]]
