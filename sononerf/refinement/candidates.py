# SPDX-License-Identifier: MIT
"""Candidates of a refinement: each is one start that goes through the stages in one way."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass, field
from typing import Any, Literal

import numpy as np
import trimesh
from torch import Tensor

from sononerf.echoes.free_space import EchoHull
from sononerf.numerics import Floats
from sononerf.refinement.descent import STAGES, Stage
from sononerf.refinement.objective import ErrorLevel
from sononerf.refinement.remesh import distance_from
from sononerf.start.read_out import LEVELS, StartMethod
from sononerf.start.surface import judge_openness

CHANCE_RATIO = 1.15
"""Ratio of two objectives of validation poses below which two surfaces differ by chance. Within it,
a sheet goes on after the first stage, or else one way before another. A refined surface is
preferred to its start within it: a start that was made from the onsets fits them even where it is
wrong."""
RANKS_DB = 4.0
"""Objective below which it ranks surfaces rightly, dB. Above it, surfaces with a lower objective
are often worse: on bodies of bars and blocks it falls from stage to stage while the F-score falls
too (``docs/notes/surface.md``). So above it a torn surface loses against its start. A closed
candidate wins against one that is not closed. Within ``CHANCE_RATIO``, ``levels`` is preferred to
the other start, because the network was trained on many bodies. Of the surfaces of ``levels``, the
earliest one within ``CHANCE_RATIO`` of the best is kept."""
SAME_SURFACE_DISTANCE = 1 / 16
"""Mean distance below which two surfaces sound alike, shortest wavelengths: the way there and back
counts it twice, so it changes phases by at most 45 degrees. One of them is enough."""
LATER_STAGE_RATIO = 1.03
"""Ratio of two objectives of one candidate below which the later stage is preferred: on smooth
bodies later stages are nearer to the truth at the same objective. Edges lose in later stages, and
there the objective rises by 5 % and more (beaker, star)."""
Schedule = Literal["blurred", "sharp", "sheet", "planes"]
"""Way of a surface through the stages. ``blurred``: with the blur and the edges of each stage,
unless the blur would take away thin parts. ``sharp``: without blur, on fine triangles. ``sheet``:
its triangles are kept, because a signed distance on voxels would tear it. ``planes``: its flat
parts move as planes, and are found anew in each stage."""


@dataclass(eq=False)
class Candidate:
    """A start that goes through the stages in one way."""

    schedule: Schedule  # The way
    start: StartMethod  # Name of the start
    level: ErrorLevel  # Its gains and errors
    meshes: list[trimesh.Trimesh]  # The start, and the surface after each stage so far, m
    # Objectives of these on the validation poses; NaN for a start that was not compared
    objectives: list[float]
    # m: Range resolution. A surface that is farther from its start at the median is torn
    far: float = math.inf
    # Number of its steps so far; it determines their poses, so that a candidate does not depend on
    # the others
    drawn: int = 0
    _torn: dict[int, bool] = field(default_factory=dict, repr=False)

    @property
    def best(self) -> int:
        """Number of the best surface: 0, the start, where all refined ones are clearly worse.

        Of surfaces that explain the echoes about as well it is the latest one; but the earliest one
        of ``levels`` where the objective hardly ranks.
        """
        start, *refined = self.objectives
        refined = [
            math.inf if one > RANKS_DB and self.torn(number) else one
            for number, one in enumerate(refined, 1)
        ]
        least = min(refined, default=math.inf)
        if math.isinf(least) or least > CHANCE_RATIO * start:
            return 0
        if self.start == "levels" and self.schedule != "planes" and least > RANKS_DB:
            return next(n for n, one in enumerate([start, *refined]) if one <= CHANCE_RATIO * least)
        return max(n for n, found in enumerate(refined, 1) if found <= LATER_STAGE_RATIO * least)

    @property
    def objective(self) -> float:
        """Objective of the best surface, dB."""
        return self.objectives[self.best]

    def torn(self, number: int) -> bool:
        """Whether a surface has more parts than its start, or is farther from it than ``far``."""
        if number not in self._torn:
            start, mesh = self.meshes[0], self.meshes[number]
            self._torn[number] = parts_of(mesh) > parts_of(start) or (
                float(np.median(distances(mesh, start))) > self.far
            )
        return self._torn[number]


def below(state: dict[str, Tensor], name: str) -> dict[str, Tensor]:
    """Return the tensors whose names begin with a name, by the rest of theirs."""
    return {key.removeprefix(name): part for key, part in state.items() if key.startswith(name)}


def planned(
    starts: Mapping[StartMethod, float], *, flat: bool = False
) -> list[tuple[StartMethod, Schedule]]:
    """Return the start and the way of each candidate."""
    others = [name for name in starts if name not in (*LEVELS, "sheet")]
    chosen: list[StartMethod] = [name for name in LEVELS if name in starts]
    chosen += sorted(others, key=lambda name: starts[name])[:1]
    pairs: list[tuple[StartMethod, Schedule]] = []
    for name in chosen:
        if not flat and (name != "levels" or "fuller" not in starts):
            pairs.append((name, "blurred"))
        pairs.append((name, "sharp"))
    pairs += [("sheet", "sheet")] if "sheet" in starts else []
    return [("levels", "planes"), *pairs] if flat else pairs


def without_twin(candidate: Candidate, candidates: list[Candidate]) -> list[Candidate]:
    """Make a candidate sharp; return all candidates without the other sharp one of its start."""
    candidate.schedule = "sharp"
    return [
        one
        for one in candidates
        if one is candidate or (one.start, one.schedule) != (candidate.start, candidate.schedule)
    ]


def number_of_steps(starts: Iterable[StartMethod], stages: tuple[Stage, ...] = STAGES) -> int:
    """Return the steps of a refinement of start methods, at most; a sheet goes on alone."""
    pairs = planned(dict.fromkeys(starts, 0.0))
    further = max(1, len({start for start, _ in pairs if start not in ("fuller", "sheet")}))
    return len(pairs) * stages[0].steps + further * sum(stage.steps for stage in stages[1:])


def after_first_stage(
    candidates: list[Candidate], misfit: Callable[[trimesh.Trimesh], float]
) -> list[Candidate]:
    """Return the candidates that go on after the first stage, the best one first.

    A sheet that is about as good as the best one goes on alone. Of planes and the best of the
    others the better one goes on, in doubt both; only their errors count, because free surfaces
    follow the onsets and planes do not. Else each start goes on in its better way, ``levels`` and
    ``fuller`` as one, but none that is clearly worse.
    """
    good = CHANCE_RATIO * min(one.objectives[-1] for one in candidates)
    sheets = [one for one in candidates if one.schedule == "sheet"]
    if any(one.objectives[-1] <= good for one in sheets):
        return sheets
    if candidates[0].schedule == "planes" and len(candidates) > 1:
        pair = [candidates[0], after_first_stage(candidates[1:], misfit)[0]]
        errors = [one.objectives[-1] - misfit(one.meshes[-1]) for one in pair]
        first, second = np.argsort(errors, kind="stable")
        clear = CHANCE_RATIO * errors[first] < errors[second]
        return [pair[first]] if clear else [pair[first], pair[second]]
    left = [one for one in candidates if one.schedule != "sheet"] or sheets
    network = [one for one in left if one.start in LEVELS]
    others = [one for one in left if one.start not in LEVELS]
    chosen = [_better(group) for group in (network, others) if group]
    for one in chosen:
        if one.start == "fuller":  # it goes on as levels, and is compared with that start
            one.start = "levels"
            one.meshes[0] = next(each.meshes[0] for each in network if each.start == "levels")
    chosen = [one for one in chosen if one.objectives[-1] <= good]
    return sorted(chosen, key=lambda one: one.objectives[-1])


def _better(candidates: list[Candidate]) -> Candidate:
    """Return the way that explains the echoes best, of one start or of both by the network.

    In doubt, a sharp one by the network, whose surfaces are smooth, so that blur wears edges and
    strokes away; of these a fuller one, because gaps stay and what is too thick becomes thinner.
    Other starts are rough, and in doubt a blurred one goes on.
    """
    near = CHANCE_RATIO * min(one.objectives[-1] for one in candidates)

    def order(one: Candidate) -> tuple[bool, bool, bool, float]:
        network = one.start in LEVELS
        unfit = (one.schedule == "blurred") == network
        return one.objectives[-1] > near, unfit, one.start == "levels", one.objectives[-1]

    return min(candidates, key=order)


def are_alike(one: Candidate, other: Candidate, wavelength: float) -> bool:
    """Return whether two surfaces sound alike after the first stage, at the shortest wavelength."""
    return (
        float(distances(one.meshes[1], other.meshes[1]).mean())
        <= SAME_SURFACE_DISTANCE * wavelength
    )


def best_of(candidates: list[Candidate], is_closed: Callable[[trimesh.Trimesh], bool]) -> Candidate:
    """Return the candidate of the least objective, in doubt ``levels`` or a closed one."""
    least = min(candidates, key=lambda one: one.objective)
    if least.objective <= RANKS_DB or len(candidates) == 1:
        return least
    closed = [one for one in candidates if is_closed(one.meshes[one.best])] or candidates
    near = CHANCE_RATIO * min(one.objective for one in closed)
    return min(closed, key=lambda one: (one.objective > near, one.start != "levels", one.objective))


def closed_before(hull: EchoHull, resolution: float) -> Callable[[trimesh.Trimesh], bool]:
    """Return whether a surface encloses a body, as far as the poses of a hull can have heard it."""

    def is_closed(mesh: trimesh.Trimesh) -> bool:
        found = judge_openness(mesh, hull.sources, resolution=resolution, plane=hull.plane)
        return found.kind != "one-sided"

    return is_closed


def listed(
    starts: Iterable[StartMethod],
    compared: Mapping[StartMethod, float],
    candidates: list[Candidate],
    chosen: Candidate,
) -> list[dict[str, Any]]:
    """Return what is told of the candidates, see ``Refined.candidates``."""

    def finite(value: float | None) -> float | None:
        return value if value is not None and math.isfinite(value) else None

    refined = {one.start: one.objective for one in candidates if len(one.meshes) > 1}
    return [
        {
            "start": name,
            "start_error_db": finite(compared.get(name)),
            "error_db": finite(refined.get(name)),
            "chosen": name == chosen.start,
        }
        for name in starts
        if name != "fuller"
    ]


def parts_of(mesh: trimesh.Trimesh) -> int:
    """Return the number of parts with more than 1 % of the area of the largest one."""
    areas = [part.area for part in mesh.split(only_watertight=False)]
    return int(np.sum(np.asarray(areas) > 0.01 * max(areas, default=0.0)))


def distances(mesh: trimesh.Trimesh, other: trimesh.Trimesh) -> Floats:
    """Return the distance of each vertex of a mesh from another one, (V,) m."""
    spacing = float(np.median(other.edges_unique_length))
    return distance_from(other, np.asarray(mesh.vertices), spacing)
