# SPDX-License-Identifier: MIT
"""Courses of a refinement: each is one start that goes through the stages in one way."""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping
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
"""Ratio of two objectives of validation poses below which two surfaces differ by chance. Within it,
a sheet goes on after the first stage; or else the learned start before the other one, because it
knows more bodies; and then its blurred surface before its sharp one, because that is smoother.
A refined surface is also preferred to its start within it: a start that was made from the onsets
fits them even where it is wrong."""
LATER = 1.03
"""Ratio of two objectives of one course below which the later stage is preferred: on smooth bodies
later stages are nearer to the truth at the same objective. Edges lose in later stages, and there
the objective rises by 5 % and more (beaker, star)."""
Way = Literal["blurred", "sharp", "sheet"]
"""Way of a surface through the stages. ``blurred``: with the blur and the edges of each stage,
unless the blur would take away thin parts. ``sharp``: without blur, on fine triangles. ``sheet``:
its triangles are kept, because a signed distance on voxels would tear it."""


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
        """Number of the best surface: 0, the start, where all refined ones are clearly worse."""
        start, *refined = self.objectives
        least = min(refined, default=math.inf)
        if math.isinf(least) or least > TOLERATED * start:
            return 0
        return max(n for n, found in enumerate(refined, 1) if found <= LATER * least)

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


def plans(starts: Mapping[StartMethod, float]) -> list[tuple[StartMethod, Way]]:
    """Return the start and the way of each course.

    Args:
        starts: Start methods, and their objectives before the first stage.

    Returns:
        plans: The learned start and the best of the others go both ways; a sheet has its own.
    """
    others = [name for name in starts if name not in ("learned", "sheet")]
    chosen = sorted(others, key=lambda name: starts[name])[:1]
    chosen = [name for name in starts if name == "learned"] + chosen
    ways: tuple[Way, ...] = ("blurred", "sharp")
    found = [(name, way) for name in chosen for way in ways]
    return [*found, *((name, "sheet") for name in starts if name == "sheet")]


def number_of_steps(starts: Iterable[StartMethod], stages: tuple[Stage, ...] = STAGES) -> int:
    """Return the steps of a refinement of start methods: each course has a first stage."""
    courses = len(plans(dict.fromkeys(starts, 0.0)))
    return (courses - 1) * stages[0].steps + sum(stage.steps for stage in stages)


def best_of(courses: list[Course]) -> Course:
    """Return the course that goes on after the first stage, see ``TOLERATED``."""
    for told in (
        lambda course: course.way == "sheet",
        lambda course: course.start == "learned",
        lambda course: course.way == "blurred",
    ):
        good = TOLERATED * min(course.objectives[-1] for course in courses)
        near = any(told(one) and one.objectives[-1] <= good for one in courses)
        courses = [one for one in courses if told(one) == near]
    return min(courses, key=lambda course: course.objectives[-1])
