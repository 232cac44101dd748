# SPDX-License-Identifier: MIT
"""Refine a surface against measured spectrograms in stages from coarse to fine; keep the best."""

from __future__ import annotations

import itertools
import logging
import math
from collections.abc import Callable, Mapping
from typing import Any, get_args

import numpy as np
import torch
import trimesh
from torch import Tensor

from sononerf.echoes.echoes import Echoes
from sononerf.errors import SonoNerfError
from sononerf.simulation.simulator import Simulator
from sononerf.surface.refine.candidates import (
    Candidate,
    Way,
    after_first_stage,
    are_alike,
    below,
    best_of,
    closed_before,
    listed,
    planned,
    without_twin,
)
from sononerf.surface.refine.comparison import Comparison
from sononerf.surface.refine.correction import Correction
from sononerf.surface.refine.descent import (
    POSES,
    SHARP,
    STAGES,
    Descent,
    Stage,
    poses_that_hear,
)
from sononerf.surface.refine.later_bounces import LaterBounces
from sononerf.surface.refine.necks import without_necks
from sononerf.surface.refine.objective import Level, OnsetRanges
from sononerf.surface.refine.optics import Optics
from sononerf.surface.refine.plane_descent import POSES as PLANE_POSES
from sononerf.surface.refine.plane_descent import PlaneDescent, flattest
from sononerf.surface.refine.refined import Refined
from sononerf.surface.refine.remesh import finer, remesh
from sononerf.surface.refine.surface_error import surface_error
from sononerf.surface.start.read_out import LEVELS, StartMethod

logger = logging.getLogger("sononerf")

SIMULATED = 96
"""Number of training poses for which a surface is simulated; each is drawn about three times."""
SMOOTH = 1 / 16
"""Largest height of the ridges of ``hull`` with which it is a start, shortest wavelengths; phases
change by at most 45 degrees. A hull fits the onsets by construction, so its objective is too good
where it is coarse. From 100 calls its ridges are 0.08 or higher; there a stool had an F-score at
2 mm of 0.24 with it and of 0.45 without. From 400 calls they are at most 0.04."""
Simulate = Callable[[trimesh.Trimesh], Simulator]
STATE_VERSION = 8
"""Version of :meth:`Refinement.state`; to be raised when its tensors change."""


def refine(
    starts: Mapping[StartMethod, trimesh.Trimesh],
    echoes: Echoes,
    *,
    optics: Optics | None = None,
    simulate: Simulate,
    seed: int,
    state: dict[str, Tensor] | None = None,
    after_step: Callable[[Refinement, float], None] | None = None,
) -> Refined:
    """Refine start surfaces against echoes.

    Args:
        starts, echoes, simulate, seed: As in :class:`Refinement`.
        optics: On the device of the computation; that of the echoes' head on the CPU where None.
        state: State of an interrupted refinement of the same starts and echoes, which resumes.
        after_step: Called after each step with the refinement and the step's mismatch, dB.
    """
    work = Refinement(starts, echoes, optics or Optics(echoes.head), simulate=simulate, seed=seed)
    if state is not None:
        work.load(state)
    while not work.done:
        mismatch = work.advance()
        if after_step is not None:
            after_step(work, mismatch)
    return work.result()


class Refinement:
    """Refinement, step by step; between any two steps it can be stopped, saved and resumed.

    Args:
        meshes: Start surfaces, m. ``levels``, ``sheet`` and the best of the others go through the
            first stage; one or two of the results go through the later stages, see
            :func:`~sononerf.surface.refine.candidates.after_first_stage`.
        echoes: Measured spectrograms and onsets; the surface must begin at the onsets. If their
            level is absolute, gains are learned in the last stage alone: a rough surface is too
            faint, and a gain would hide that. Otherwise gains are learned from the first stage on.
        optics: The head; its device is that of the computation.
        simulate: Makes the simulator of a surface, for the stages that are corrected by it.
        seed: Seed of the order of poses and of traced rays.
        stages: From coarse to fine; ``STAGES`` where None.

    Attributes:
        candidates: Those of the first stage; after it, those that go on.
        history: As in :class:`Refined`, so far.
        newest: The surface that the last entry of the history tells of; None before the first, and
            after a state was taken over.
    """

    def __init__(
        self,
        meshes: Mapping[StartMethod, trimesh.Trimesh],
        echoes: Echoes,
        optics: Optics,
        *,
        simulate: Simulate,
        seed: int,
        stages: tuple[Stage, ...] | None = None,
    ) -> None:
        self.simulate = simulate
        self.echoes, self.optics, self.seed = echoes, optics, seed
        self.stages = stages or STAGES
        self.onsets = OnsetRanges(echoes.hull, optics.head.resolution, seed)
        self.starts = {name: _plain(mesh) for name, mesh in meshes.items()}
        self.candidates: list[Candidate] = []
        self.stage, self.step, self.drawn = 0, 0, 0
        self.history: list[dict[str, Any]] = []
        self.faults: list[str] = []
        self.newest: trimesh.Trimesh | None = None
        self.compared: dict[StartMethod, float] = {}
        self._far = optics.head.resolution
        self._at = 0  # number of the present candidate
        self._descent: Descent | PlaneDescent | None = None
        self._later: LaterBounces | None = None
        self._source = 0  # number of the surface whose later bounces are added
        self.comparison = Comparison(echoes, optics, self.onsets, seed)

    @property
    def done(self) -> bool:
        """True if nothing is left to do."""
        return self.stage >= len(self.stages)

    @property
    def candidate(self) -> Candidate:
        """The present candidate."""
        if not self.candidates:
            self._choose()
        return self.candidates[self._at]

    def advance(self) -> float:
        """Do one step; return its mismatch, dB."""
        stage, candidate = self.stages[self.stage], self.candidate
        if self._descent is None:
            if stage.beyond == "trace":
                self._source = len(candidate.meshes) - 1
            self._descent = self._descend(self._prepared())
        mismatch = self._descent.step(candidate.drawn, self.step / stage.steps)
        candidate.drawn += 1
        self.step += 1
        self.drawn += 1
        if self.step == stage.steps:
            self._finish(mismatch)
        return mismatch

    def _prepared(self) -> trimesh.Trimesh:
        """Return the surface that a stage begins with."""
        stage, unit = self.stages[self.stage], self.optics.wavelength
        candidate, plane = self.candidate, self.optics.plane
        before = candidate.meshes[-1]
        if candidate.way in ("sheet", "planes"):
            return before
        made = None
        if candidate.way == "blurred":
            made = remesh(before, stage.edge * unit, stage.blur * unit, plane)
            if made is None and self.stage == 0:  # later blurs would remove thin parts
                self.candidates = without_twin(candidate, self.candidates)
        if made is None:
            made = remesh(before, min(SHARP, stage.edge) * unit, 0.0, plane)
        return before if made is None else made

    def _finish(self, mismatch: float) -> None:
        """End a stage of the present candidate."""
        assert self._descent is not None
        candidate, mesh = self.candidate, self._descent.mesh()
        self._descent, self.step = None, 0
        name = f"the surface of stage {self.stage}"
        objective = self._objective(mesh, name, candidate.level, smooth=candidate.way != "planes")
        self.history.append(
            {
                "stage": self.stage,
                "start": candidate.start,
                "way": candidate.way,
                "mismatch_db": mismatch,
                "objective_db": objective,
            }
        )
        self.newest = mesh
        candidate.meshes.append(mesh)
        candidate.objectives.append(objective)
        if self.stage == 0 and self._at + 1 < len(self.candidates):
            self._at += 1
            return
        if self.stage == 0:
            self.candidates = after_first_stage(self.candidates, self.comparison.misfit)
            self._at = 0
            for one in self.candidates:
                if math.isnan(one.objectives[0]):
                    # Planes may have begun from the fuller surface; they compete with levels.
                    one.meshes[0] = self.starts[one.start]
                    one.objectives[0] = self._compared(one.start)
            self._later = None
        self.stage += 1
        first, *others = self.candidates
        if self.done and self._at < len(others) and len(self.stages) > 1:
            if not are_alike(others[self._at], first, self.optics.wavelength):
                self._at, self.stage, self._later = self._at + 1, 1, None

    def _choose(self) -> None:
        """Begin the candidates; of the starts other than levels and sheet, the best takes part."""
        names = [name for name in self.starts if name not in (*LEVELS, "sheet")]
        found = dict.fromkeys(self.starts, math.nan)
        if len(names) > 1 and "hull" in names:
            ridges = self.onsets.ridges(self.starts["hull"])
            if ridges > SMOOTH * self.optics.wavelength:
                names.remove("hull")
                del found["hull"]
        if len(names) > 1:
            found.update({name: self._compared(name) for name in names})
        network = [self.starts[name] for name in LEVELS if name in self.starts]
        with_planes = [] if self.optics.plane else network
        flat = flattest(with_planes, self._error, self.optics)
        for start, way in planned(found, flat=flat is not None):
            mesh = flat if way == "planes" and flat is not None else self.starts[start]
            begun = Candidate(way, start, self._new_level(), [mesh], [found[start]], self._far)
            self.candidates.append(begun)

    def _new_level(self) -> Level:
        like = self.optics.get_buffer("wavenumber")
        return Level(self.optics.ears, len(self.optics.frequencies), like)

    def _compared(self, name: StartMethod) -> float:
        """Return the objective of a start."""
        mesh, level = self.starts[name], self._new_level()
        self.compared[name] = self._objective(mesh, f"the start {name}", level, smooth=False)
        return self.compared[name]

    def _objective(
        self,
        mesh: trimesh.Trimesh,
        name: str = "a surface",
        level: Level | None = None,
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

    def _descend(self, mesh: trimesh.Trimesh) -> Descent | PlaneDescent:
        stage, candidate = self.stages[self.stage], self.candidate
        last = self.stage == len(self.stages) - 1
        candidate.level.learns = "none" if self.echoes.calibrated and not last else "each"
        correction = None
        planes = candidate.way == "planes"
        if stage.beyond == "simulate" and not planes:
            self._later, correction = None, self._correction(mesh)
        elif stage.beyond == "none":
            self._later = None
        elif stage.beyond == "trace" or self._later is None:
            source = candidate.meshes[self._source]
            self._later = LaterBounces(self.optics, source, self.echoes, seed=self.seed)
            self._later.trace(self._coming())
        if planes:
            return PlaneDescent(
                mesh,
                self.echoes,
                self.optics,
                candidate.level,
                rate=stage.rate,
                later=self._later,
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
            later=self._later,
            correction=correction,
            # The simulator's correction is more exact than the onsets.
            onsets=None if correction is not None else self.onsets,
            sheet=candidate.way == "sheet",
            band=stage.band,
            seed=self.seed,
        )

    def _coming(self) -> list[int]:
        """Return the poses of all further steps that use the later bounces of this surface."""
        steps, first = self.stages[self.stage].steps - self.step, self.candidate.drawn
        poses = PLANE_POSES if self.candidate.way == "planes" else POSES
        for stage in itertools.takewhile(
            lambda stage: stage.beyond == "keep", self.stages[self.stage + 1 :]
        ):
            steps += stage.steps
        drawn = [
            self.echoes.batch(self.seed, first + step, poses).tolist() for step in range(steps)
        ]
        return sorted(set(itertools.chain.from_iterable(drawn)))

    def _correction(self, mesh: trimesh.Trimesh) -> Correction | None:
        """Return the correction on a surface; None where it cannot be simulated."""
        training = self.echoes.training
        rng = np.random.default_rng([self.seed, self.stage])
        numbers = rng.choice(training, min(SIMULATED, len(training)), replace=False)
        fine, _ = finer(mesh, np.zeros(len(mesh.vertices)), self.optics.wavelength)
        try:
            simulator = self.simulate(fine)
            return Correction(self.optics, mesh, simulator, self.echoes, numbers, seed=self.seed)
        except SonoNerfError as error:
            self._note(f"stage {self.stage} goes without the simulator's correction: {error}")
            return None

    def state(self) -> dict[str, Tensor]:
        """Return all that is needed to go on, as plain tensors."""
        starts, ways = list(self.starts), get_args(Way)
        found = {
            "progress": torch.tensor([self.stage, self.step, self.drawn, self._at, self._source]),
            "history": torch.tensor(
                [
                    (
                        one["stage"],
                        starts.index(one["start"]),
                        ways.index(one["way"]),
                        one["mismatch_db"],
                        one["objective_db"],
                    )
                    for one in self.history
                ],
                dtype=torch.float64,
            ).reshape(-1, 5),
            "faults": torch.tensor(list("\n".join(self.faults).encode()), dtype=torch.uint8),
            "compared": torch.tensor(
                [self.compared.get(name, math.nan) for name in starts], dtype=torch.float64
            ),
        }
        for number, candidate in enumerate(self.candidates):
            parts = candidate.state()
            found.update({f"candidate.{number}.{name}": part for name, part in parts.items()})
        if self._descent is not None:
            parts = self._descent.state()
            found.update({f"descent.{name}": part for name, part in parts.items()})
        return found

    def load(self, state: dict[str, Tensor]) -> None:
        """Go on from a state; meshes, echoes, optics, seed and stages must be the same."""
        self.stage, self.step, self.drawn, self._at, self._source = (
            int(part) for part in state["progress"]
        )
        starts, ways = list(self.starts), get_args(Way)
        self.candidates = []
        while parts := below(state, f"candidate.{len(self.candidates)}."):
            self.candidates.append(Candidate.of(parts, self._new_level(), self._far))
        self.history = [
            {
                "stage": int(stage),
                "start": starts[int(start)],
                "way": ways[int(way)],
                "mismatch_db": mismatch,
                "objective_db": objective,
            }
            for stage, start, way, mismatch, objective in state["history"].tolist()
        ]
        self.faults = bytes(state["faults"].tolist()).decode().splitlines()
        compared = zip(starts, state["compared"].tolist(), strict=True)
        self.compared = {name: error for name, error in compared if not math.isnan(error)}
        self._later, self._descent = None, None
        if parts := below(state, "descent."):
            begun = trimesh.Trimesh(parts["start"].numpy(), parts["faces"].numpy(), process=False)
            self._descent = self._descend(begun)
            self._descent.load(parts)

    def result(self) -> Refined:
        """Return the best surface so far; the start where all refined ones are clearly worse."""
        if not self.candidates:
            self._choose()
        candidate = best_of(self.candidates, closed_before(self.echoes.hull, self._far))
        best = candidate.best
        mesh, doubtful = without_necks(
            candidate.meshes[best],
            self.optics.wavelength,
            lambda mesh: self._objective(
                mesh, "a surface with a cut neck", candidate.level, smooth=False
            ),
        )
        confidence = poses_that_hear(mesh, self.echoes, self.optics).cpu().double().numpy()
        known = surface_error(
            mesh,
            self.echoes,
            self.optics,
            starts=[mesh for name, mesh in self.starts.items() if name != "fuller"],
            validation_db=candidate.objective,
            seed=self.seed,
        )
        confidence *= known.heard & ~doubtful
        values = np.stack([confidence, known.error], axis=1)
        if best and candidate.way != "planes":
            mesh, values = finer(mesh, values, self.optics.wavelength)
        return Refined(
            mesh=mesh,
            gain=candidate.level.gain.exp().cpu().double().numpy(),
            confidence=values[:, 0],
            error=values[:, 1],
            start=candidate.start,
            kept=best > 0,
            error_db=candidate.objective,
            history=self.history,
            faults=self.faults,
            candidates=listed(self.starts, self.compared, self.candidates, candidate),
        )


def _plain(mesh: trimesh.Trimesh) -> trimesh.Trimesh:
    vertices, faces = np.array(mesh.vertices, np.float64), np.array(mesh.faces, np.int64)
    return trimesh.Trimesh(vertices, faces, process=False)
