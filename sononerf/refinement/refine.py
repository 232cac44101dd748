# SPDX-License-Identifier: MIT
"""Refine a surface against measured spectrograms in stages from coarse to fine; keep the best.

In: start surfaces by name, echoes. Out: the surface with the lowest error on validation poses, with
the error of each vertex. Two loops: all candidates go through the first stage, the better ones
through the others. In the last stages the simulator corrects the optics. Section 5 of
``docs/method.md``.
"""

from __future__ import annotations

import itertools
import logging
import math
from collections.abc import Callable, Mapping, MutableMapping
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
import trimesh
from torch import Tensor

from sononerf.echoes.echoes import Echoes
from sononerf.errors import SonoNerfError
from sononerf.numerics import Floats
from sononerf.refinement.descent import (
    POSES,
    SHARP_EDGE,
    STAGES,
    Candidate,
    Descent,
    Stage,
    after_first_stage,
    below,
    planned,
    poses_that_hear,
    without_twin,
)
from sononerf.refinement.objective import ErrorLevel, OnsetRanges, SurfaceComparison
from sononerf.refinement.optics import Optics
from sononerf.refinement.plane_descent import POSES as PLANE_POSES
from sononerf.refinement.plane_descent import PlaneDescent, flattest
from sononerf.refinement.remesh import finer, remesh
from sononerf.refinement.surface_error import surface_error
from sononerf.refinement.tracer import Correction, LaterBounces
from sononerf.simulation.simulator import Simulator
from sononerf.start.network import StartMethod


@dataclass(frozen=True, eq=False)
class Refined:
    """A refined surface."""

    mesh: trimesh.Trimesh  # m
    gain: Floats  # (E, F): Factor of rendered magnitudes, learned on training poses
    # (V,): Number of training poses that see each vertex near the direction of a mirror; 0 where
    # echoes do not bound its place
    confidence: Floats
    error: Floats  # (V,), m: See :mod:`sononerf.refinement.surface_error`
    start: StartMethod  # Name of the start that was refined
    # Objective on validation poses, see :class:`~sononerf.refinement.objective.Comparison`
    error_db: float
    # Per stage: its number, start, schedule, last mismatch, and objective after it
    history: list[dict[str, Any]]
    # Faults of the refinement, one line each: a surface that could not be traced and counted as the
    # worst, or a stage that went without the simulator's correction
    faults: list[str]


logger = logging.getLogger("sononerf")

CORRECTION_POSES = 96
"""Number of training poses for which a surface is simulated; each is drawn about three times."""
Simulate = Callable[[trimesh.Trimesh], Simulator]
Saved = MutableMapping[str, dict[str, Tensor]]
"""Stages that are done, by the names of their candidates and their numbers."""


class Refinement:
    """Moves start surfaces until physical optics, corrected by the simulator, gives the echoes.

    Attributes:
        candidates: All of them; after the first stage, those that go on.
        history: As in :class:`Refined`, so far.
    """

    def __init__(
        self,
        meshes: Mapping[StartMethod, trimesh.Trimesh],
        echoes: Echoes,
        optics: Optics,
        *,
        simulate: Simulate,
        seed: int,
        stages: tuple[Stage, ...] = STAGES,
        saved: Saved | None = None,
        after_step: Callable[[int, float], None] | None = None,
        after_stage: Callable[[trimesh.Trimesh, float], None] | None = None,
    ) -> None:
        self.simulate, self.stages = simulate, stages
        self.echoes, self.optics, self.seed = echoes, optics, seed
        self.saved = {} if saved is None else saved
        self._after_step, self._after_stage = after_step, after_stage
        self.onsets = OnsetRanges(echoes.hull, optics.head.resolution, seed)
        self.comparison = SurfaceComparison(echoes, optics, self.onsets, seed)
        self.starts = {name: _plain(mesh) for name, mesh in meshes.items()}
        self.history: list[dict[str, Any]] = []
        self.faults: list[str] = []
        self._later: tuple[Candidate, LaterBounces] | None = None
        self.candidates = self._begun()

    def run(self) -> Refined:
        """Return the surface that explains the validation poses best.

        Every candidate goes through the first stage, and one or two of them through the others,
        see :func:`~sononerf.refinement.descent.after_first_stage`.
        """
        self.first_stage()
        for candidate in self.candidates:
            for number in range(1, len(self.stages)):
                self.stage(candidate, number)
        return self.result()

    def first_stage(self) -> None:
        """Do the first stage of all candidates, and leave those that lose."""
        for candidate in list(self.candidates):
            if candidate in self.candidates:
                self.stage(candidate, 0)
        self.candidates = after_first_stage(self.candidates, self.comparison.misfit)

    def stage(self, candidate: Candidate, number: int) -> None:
        """Do a stage of a candidate, or take it from the saved ones."""
        key = f"{candidate.start}-{candidate.schedule}-{number}"
        if key not in self.saved:
            self.saved[key] = self._done(candidate, number)
        elif self._after_step is not None:
            self._after_step(self.stages[number].steps, float(self.saved[key]["mismatch"]))
        saved = self.saved[key]
        mesh = trimesh.Trimesh(saved["vertices"].numpy(), saved["faces"].numpy(), process=False)
        mismatch, objective = float(saved["mismatch"]), float(saved["objective"])
        if saved["thin"] and candidate.schedule == "blurred":
            self.candidates = without_twin(candidate, self.candidates)
        for fault in bytes(saved["faults"].tolist()).decode().splitlines():
            self._note(fault)
        candidate.level.load(below(saved, "level."))
        candidate.drawn += self.stages[number].steps
        candidate.meshes.append(mesh)
        candidate.objectives.append(objective)
        self.history.append(
            {
                "stage": number,
                "start": candidate.start,
                "schedule": candidate.schedule,
                "mismatch_db": mismatch,
                "objective_db": objective,
            }
        )
        if self._after_stage is not None:
            self._after_stage(mesh, objective)

    def _done(self, candidate: Candidate, number: int) -> dict[str, Tensor]:
        """Do a stage of a candidate; return its surface and all that the next one needs."""
        before, mismatch, steps = len(self.faults), math.inf, self.stages[number].steps
        begun, thin = self._prepared(candidate, number)
        descent = self._descend(candidate, number, begun)
        for step in range(steps):
            mismatch = descent.step(candidate.drawn + step, step / steps)
            if self._after_step is not None:
                self._after_step(1, mismatch)
        mesh, name = descent.mesh(), f"the surface of stage {number}"
        objective = self._objective(
            mesh, name, candidate.level, smooth=candidate.schedule != "planes"
        )
        text = "\n".join(self.faults[before:]).encode()
        return {
            "vertices": torch.as_tensor(np.array(mesh.vertices)),
            "faces": torch.as_tensor(np.array(mesh.faces)),
            "mismatch": torch.tensor(mismatch, dtype=torch.float64),
            "objective": torch.tensor(objective, dtype=torch.float64),
            "thin": torch.tensor(thin),
            "faults": torch.tensor(list(text), dtype=torch.uint8),
            **{f"level.{key}": part.clone() for key, part in candidate.level.state().items()},
        }

    def _prepared(self, candidate: Candidate, number: int) -> tuple[trimesh.Trimesh, bool]:
        """Return the surface that a stage begins with, and whether it is too thin for its blur."""
        stage, unit, plane = self.stages[number], self.optics.wavelength, self.optics.plane
        before = candidate.meshes[-1]
        if candidate.schedule == "planes":
            return before, False
        made = None
        if candidate.schedule == "blurred":
            made = remesh(before, stage.edge * unit, stage.blur * unit, plane)
        # In the first stage such a start becomes sharp; later blurs would remove thin parts.
        thin = candidate.schedule == "blurred" and made is None and number == 0
        if made is None:
            made = remesh(before, min(SHARP_EDGE, stage.edge) * unit, 0.0, plane)
        return (before if made is None else made), thin

    def _begun(self) -> list[Candidate]:
        """Return all candidates."""
        network = [self.starts[name] for name in ("levels", "fuller") if name in self.starts]
        flat = flattest([] if self.optics.plane else network, self._error, self.optics)
        candidates = []
        for start, schedule in planned(self.starts, flat=flat is not None):
            mesh = flat if schedule == "planes" and flat is not None else self.starts[start]
            begun = Candidate(schedule, start, self._new_level(), [mesh], [math.nan])
            candidates.append(begun)
        return candidates

    def _new_level(self) -> ErrorLevel:
        like = self.optics.get_buffer("wavenumber")
        return ErrorLevel(self.optics.ears, len(self.optics.frequencies), like)

    def _objective(
        self,
        mesh: trimesh.Trimesh,
        name: str = "a surface",
        level: ErrorLevel | None = None,
        *,
        smooth: bool = False,
    ) -> float:
        """Return the objective of a surface; infinite if it cannot be traced."""
        try:
            level = level or self._new_level()
            return self.comparison.objective(mesh, level, smooth=smooth)
        except SonoNerfError as error:
            self._note(f"{name} cannot be compared and counts as the worst: {error}")
            return math.inf

    def _error(self, mesh: trimesh.Trimesh) -> float:
        """Return the error of a surface without its onsets, dB."""
        return self._objective(mesh) - self.comparison.misfit(mesh)

    def _note(self, fault: str) -> None:
        """Record a fault, and warn of it once."""
        if fault not in self.faults:
            self.faults.append(fault)
            logger.warning("%s", fault)

    def _descend(
        self, candidate: Candidate, number: int, mesh: trimesh.Trimesh
    ) -> Descent | PlaneDescent:
        """Return the descent of a stage."""
        stage, planes = self.stages[number], candidate.schedule == "planes"
        last = number == len(self.stages) - 1
        candidate.level.learns = "none" if self.echoes.calibrated and not last else "each"
        corrects = stage.beyond == "simulate" and not planes
        correction = self._correction(mesh, number) if corrects else None
        later = None if corrects else self._later_bounces(candidate, number)
        if planes:
            return PlaneDescent(
                mesh,
                self.echoes,
                self.optics,
                candidate.level,
                rate=stage.rate,
                later=later,
                band=stage.band,
                seed=self.seed,
            )
        return Descent(
            mesh,
            self.echoes,
            self.optics,
            candidate.level,
            smoothing=stage.smoothing * self.optics.wavelength,
            rate=stage.rate,
            later=later,
            correction=correction,
            # The simulator's correction is more exact than the onsets.
            onsets=None if correction is not None else self.onsets,
            band=stage.band,
            seed=self.seed,
        )

    def _later_bounces(self, candidate: Candidate, number: int) -> LaterBounces | None:
        """Return the later bounces of a stage, off the surface before the stage that traces."""
        tracing = [n for n in range(number + 1) if self.stages[n].beyond == "trace"]
        if self.stages[number].beyond == "none" or not tracing:
            return None
        if self._later is None or self._later[0] is not candidate or tracing[-1] == number:
            source = candidate.meshes[tracing[-1]]
            later = LaterBounces(self.optics, source, self.echoes, seed=self.seed)
            later.trace(self._coming(candidate, number))
            self._later = candidate, later
        return self._later[1]

    def _coming(self, candidate: Candidate, number: int) -> list[int]:
        """Return the poses of this stage and of those after it that keep its later bounces."""
        kept = itertools.takewhile(lambda stage: stage.beyond == "keep", self.stages[number + 1 :])
        steps = self.stages[number].steps + sum(stage.steps for stage in kept)
        poses = PLANE_POSES if candidate.schedule == "planes" else POSES
        first = candidate.drawn
        drawn = (self.echoes.batch(self.seed, first + step, poses) for step in range(steps))
        return sorted({int(pose) for some in drawn for pose in some})

    def _correction(self, mesh: trimesh.Trimesh, number: int) -> Correction | None:
        """Return the correction on a surface; None where it cannot be simulated."""
        training = self.echoes.training
        rng = np.random.default_rng([self.seed, number])
        numbers = rng.choice(training, min(CORRECTION_POSES, len(training)), replace=False)
        fine, _ = finer(mesh, np.zeros(len(mesh.vertices)), self.optics.wavelength)
        try:
            simulator = self.simulate(fine)
            return Correction(self.optics, mesh, simulator, self.echoes, numbers, seed=self.seed)
        except SonoNerfError as error:
            self._note(f"stage {number} goes without the simulator's correction: {error}")
            return None

    def result(self) -> Refined:
        """Return the surface of the stage that is best so far."""
        candidate = min(self.candidates, key=lambda one: one.objective)
        best = candidate.best
        mesh = candidate.meshes[best]
        confidence = poses_that_hear(mesh, self.echoes, self.optics).cpu().double().numpy()
        deviation = surface_error(
            mesh,
            self.echoes,
            self.optics,
            starts=list(self.starts.values()),
            validation_db=candidate.objective,
            seed=self.seed,
        )
        confidence *= deviation.heard
        values = np.stack([confidence, deviation.error], axis=1)
        if candidate.schedule != "planes":
            mesh, values = finer(mesh, values, self.optics.wavelength)
        return Refined(
            mesh=mesh,
            gain=candidate.level.gain.exp().cpu().double().numpy(),
            confidence=values[:, 0],
            error=values[:, 1],
            start=candidate.start,
            error_db=candidate.objective,
            history=self.history,
            faults=self.faults,
        )


def _plain(mesh: trimesh.Trimesh) -> trimesh.Trimesh:
    vertices, faces = np.array(mesh.vertices, np.float64), np.array(mesh.faces, np.int64)
    return trimesh.Trimesh(vertices, faces, process=False)
