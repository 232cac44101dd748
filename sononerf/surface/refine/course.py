# SPDX-License-Identifier: MIT
"""Courses of a refinement: each is one start that goes through the stages in one way."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass
from typing import Any, Literal, cast

import numpy as np
import torch
import trimesh
from torch import Tensor

from sononerf.surface.refine.descent import STAGES, Stage
from sononerf.surface.refine.objective import Level
from sononerf.surface.start.read_out import StartMethod

TOLERATED = 1.15
"""Ratio of two objectives of validation poses below which they differ by chance. Within it, a later
stage is preferred; after the first stage a sheet is preferred, or else the blurred surface to the
sharp one, because it is smoother. The learned start and another one within it both go on."""
Way = Literal["blurred", "sharp", "learned", "sheet"]
"""Way of a surface through the stages. ``blurred``: with the blur and the edges of each stage,
unless the blur would take away thin parts. ``sharp``: without blur, on fine triangles. ``learned``:
the same, from the start of this name. ``sheet``: its triangles are kept, because a signed distance
on voxels would tear it."""
OWN: tuple[Literal["learned", "sheet"], ...] = ("learned", "sheet")
"""Starts that have a way of their own."""


@dataclass(eq=False)
class Course:
    """A start that goes through the stages in one way.

    Attributes:
        way: The way.
        start: Name of the start.
        level: Its gains and errors.
        meshes: The start, and the surface after each stage so far, m.
        objectives: Objectives of these on the validation poses; NaN for a start that was not
            compared.
    """

    way: Way
    start: StartMethod
    level: Level
    meshes: list[trimesh.Trimesh]
    objectives: list[float]

    @property
    def best(self) -> int:
        """Number of the best surface: 0, the start, where none explains more."""
        good = TOLERATED * min(self.objectives)
        better = [n for n, found in enumerate(self.objectives) if found < self.objectives[0]]
        return max([n for n in better if self.objectives[n] <= good], default=0)

    def state(self) -> dict[str, Tensor]:
        """Return all as plain tensors."""
        found = {f"level.{name}": part for name, part in self.level.state().items()}
        found["names"] = torch.tensor(list(f"{self.way} {self.start}".encode()), dtype=torch.uint8)
        found["objectives"] = torch.tensor(self.objectives, dtype=torch.float64)
        for stage, mesh in enumerate(self.meshes):
            found[f"mesh.{stage}.vertices"] = torch.as_tensor(np.array(mesh.vertices))
            found[f"mesh.{stage}.faces"] = torch.as_tensor(np.array(mesh.faces))
        return found

    @classmethod
    def of(cls, state: dict[str, Tensor], level: Level) -> Course:
        """Return the course of a state.

        Args:
            state: From :meth:`state`.
            level: Takes over that of the state.
        """
        level.load(below(state, "level."))
        way, start = bytes(state["names"].tolist()).decode().split(" ", 1)
        meshes: list[trimesh.Trimesh] = []
        while parts := below(state, f"mesh.{len(meshes)}."):
            vertices, faces = parts["vertices"].numpy(), parts["faces"].numpy()
            meshes.append(trimesh.Trimesh(vertices, faces, process=False))
        return cls(cast(Any, way), cast(Any, start), level, meshes, state["objectives"].tolist())


def below(state: dict[str, Tensor], name: str) -> dict[str, Tensor]:
    """Return the tensors whose names begin with a name, by the rest of theirs."""
    return {key.removeprefix(name): part for key, part in state.items() if key.startswith(name)}


def ways_of(starts: Iterable[str]) -> list[Way]:
    """Return the ways of start methods."""
    ways: list[Way] = ["blurred", "sharp"] if set(starts) - set(OWN) else []
    return [*ways, *(name for name in OWN if name in starts)]


def number_of_steps(
    starts: Iterable[str], stages: tuple[Stage, ...] = STAGES, courses: int = 1
) -> int:
    """Return the steps of a refinement; each way has a first stage, and some courses go on.

    Args:
        starts: Start methods.
        stages: From coarse to fine.
        courses: Number of courses that go on after the first stage.
    """
    later = sum(stage.steps for stage in stages[1:])
    return len(ways_of(starts)) * stages[0].steps + courses * later


def going_on(courses: list[Course]) -> list[Course]:
    """Return the courses that go on after the first stage: one, or two of which one is learned."""
    good = TOLERATED * min(course.objectives[-1] for course in courses)
    found = {course.way: course for course in courses if course.objectives[-1] <= good}
    if "sheet" in found:
        return [found["sheet"]]
    plain = found.get("blurred") or found.get("sharp")
    return [course for course in (plain, found.get("learned")) if course]
