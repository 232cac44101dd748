# SPDX-License-Identifier: MIT
"""Refine a surface against measured spectrograms in stages from coarse to fine; keep the best."""

from __future__ import annotations

import itertools
import logging
import math
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass
from typing import Any, Literal

import numpy as np
import torch
import trimesh
from torch import Tensor

from sononerf.array_types import Floats
from sononerf.echoes.echoes import Echoes
from sononerf.errors import SonoNerfError
from sononerf.simulation.simulator import Simulator
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
from sononerf.surface.refine.objective import Level, OnsetRanges
from sononerf.surface.refine.optics import Optics
from sononerf.surface.refine.remesh import finer, remesh
from sononerf.surface.start.read_out import StartMethod

logger = logging.getLogger("sononerf")

SIMULATED = 96
"""Number of training poses for which a surface is simulated; each is drawn about three times."""
Simulate = Callable[[trimesh.Trimesh], Simulator]
TOLERATED = 1.15
"""Ratio of two objectives of validation poses below which they differ by chance. Within it, a later
stage is preferred; after the first stage a sheet is preferred, or else the blurred surface to the
sharp one, because it is smoother. The learned start must have the lowest objective of all."""
STATE_VERSION = 3
"""Version of :meth:`Refinement.state`; to be raised when its tensors change."""
Way = Literal["blurred", "sharp", "learned", "sheet"]
"""Way of a surface through the stages. ``blurred``: with the blur and the edges of each stage,
unless the blur would take away thin parts. ``sharp``: without blur, on fine triangles. ``learned``:
the same, from the start of this name. ``sheet``: its triangles are kept, because a signed distance
on voxels would tear it."""
_OWN: tuple[Literal["learned", "sheet"], ...] = ("learned", "sheet")  # starts with their own way


@dataclass(frozen=True, eq=False)
class Refined:
    """A refined surface.

    Attributes:
        mesh: m.
        gain (E, F): Factor of rendered magnitudes, learned on training poses.
        confidence (V,): Number of training poses that see each vertex near the direction of a
            mirror.
        start: Name of the start that was refined.
        kept: True where the refined surface explains the validation poses better than the start.
        error_db: Objective on validation poses, see
            :class:`~sononerf.surface.refine.comparison.Comparison`.
        history: Per stage: its number, its way, the mismatch of its last step, and the objective on
            validation poses after it.
        faults: Faults of the refinement, one line each: a surface that could not be traced and
            counted as the worst, or a stage that went without the simulator's correction.
    """

    mesh: trimesh.Trimesh
    gain: Floats
    confidence: Floats
    start: StartMethod
    kept: bool
    error_db: float
    history: list[dict[str, Any]]
    faults: list[str]


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


def number_of_steps(starts: Iterable[str], stages: tuple[Stage, ...] = STAGES) -> int:
    """Return the steps of a refinement of these start methods; each way has a first stage."""
    return (len(_ways(starts)) - 1) * stages[0].steps + sum(stage.steps for stage in stages)


def _ways(starts: Iterable[str]) -> list[Way]:
    ways: list[Way] = ["blurred", "sharp"] if set(starts) - set(_OWN) else []
    return [*ways, *(name for name in _OWN if name in starts)]


class Refinement:
    """Refinement, step by step; between any two steps it can be stopped, saved and resumed.

    Args:
        meshes: Start surfaces, m; the one that explains the validation poses best is refined.
            Starts with the names ``learned`` and ``sheet`` take part in the first stage beside the
            best of the others.
        echoes: Measured spectrograms and onsets; the surface must begin at the onsets. If their
            level is absolute, gains are learned in the last stage alone: a rough surface is too
            faint, and a gain would hide that. Otherwise gains are learned from the first stage on.
        optics: The head; its device is that of the computation.
        simulate: Makes the simulator of a surface, for the stages that are corrected by it.
        seed: Seed of the order of poses and of traced rays.
        stages: From coarse to fine; ``STAGES`` where None.

    Attributes:
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
        like = optics.get_buffer("wavenumber")
        self.level = Level(optics.ears, len(optics.frequencies), like)
        self.onsets = OnsetRanges(echoes.hull, optics.head.resolution, seed)
        self.starts = {name: _plain(mesh) for name, mesh in meshes.items()}
        self.candidates: list[trimesh.Trimesh] = []
        self.objectives: list[float] = []
        self.start: StartMethod | None = None
        self.stage, self.step, self.drawn = 0, 0, 0
        self.ways = _ways(meshes)
        self.way = self.ways[0]
        self.history: list[dict[str, Any]] = []
        self.faults: list[str] = []
        self.newest: trimesh.Trimesh | None = None
        self._rivals: list[trimesh.Trimesh] = []  # results of the first stage, by way
        self._descent: Descent | None = None
        self._later: LaterBounces | None = None
        self._source = 0  # the candidate whose later bounces are added
        self.comparison = Comparison(echoes, optics, self.onsets, seed)

    @property
    def done(self) -> bool:
        """True if nothing is left to do."""
        return self.stage >= len(self.stages)

    def advance(self) -> float:
        """Do one step; return its mismatch, dB."""
        stage = self.stages[self.stage]
        if self.start is None:
            self._choose()
        if self._descent is None:
            if stage.beyond == "trace":
                self._source = len(self.candidates) - 1
            self._descent = self._descend(self._prepared())
        mismatch = self._descent.step(self.drawn, self.step / stage.steps)
        self.step += 1
        self.drawn += 1
        if self.step == stage.steps:
            self._finish(mismatch)
        return mismatch

    def _prepared(self) -> trimesh.Trimesh:
        """Return the surface that a stage begins with."""
        stage, unit = self.stages[self.stage], self.optics.wavelength
        before, plane = self.candidates[-1], self.optics.plane
        if self.way in _OWN and self.stage == 0:
            before = self.starts[self.way]
        if self.way == "sheet":
            return before
        made = None
        if self.way == "blurred":
            made = remesh(before, stage.edge * unit, stage.blur * unit, plane)
        if made is None:
            made = remesh(before, min(SHARP, stage.edge) * unit, 0.0, plane)
        return before if made is None else made

    def _finish(self, mismatch: float) -> None:
        """End a stage; the first one is done in each way."""
        assert self._descent is not None
        mesh, self._descent, self.step = self._descent.mesh(), None, 0
        objective = self._objective(mesh, f"the surface of stage {self.stage}", smooth=True)
        self.history.append(
            {
                "stage": self.stage,
                "way": self.way,
                "mismatch_db": mismatch,
                "objective_db": objective,
            }
        )
        self.newest = mesh
        if self.stage == 0:
            self._rivals.append(mesh)
            if len(self._rivals) < len(self.ways):
                self.way = self.ways[len(self._rivals)]
                self.level.reset()
                return
            mesh, objective = self._best_way()
        self.candidates.append(mesh)
        self.objectives.append(objective)
        self.stage += 1

    def _best_way(self) -> tuple[trimesh.Trimesh, float]:
        """Continue in the best way; return its result of the first stage, and its objective."""
        found = dict(zip(self.ways, (one["objective_db"] for one in self.history), strict=True))
        good = TOLERATED * min(found.values())
        self.way = min(found, key=lambda way: found[way])
        smooth: tuple[Way, ...] = ("sheet",) if self.way == "learned" else ("sheet", "blurred")
        self.way = next((way for way in smooth if found.get(way, math.inf) <= good), self.way)
        if self.way in _OWN and self.start != self.way:
            self._begin([self.way])
        return self._rivals[self.ways.index(self.way)], found[self.way]

    def _choose(self) -> None:
        """Begin with the start that explains the validation poses best."""
        self._begin([name for name in self.starts if name not in _OWN] or list(self.starts))

    def _begin(self, names: list[StartMethod]) -> None:
        meshes = [self.starts[name] for name in names]
        found = [
            self._objective(mesh, f"the start {name}", smooth=False)
            for name, mesh in zip(names, meshes, strict=True)
        ]
        best = int(np.argmin(found))
        self.start, self.candidates, self.objectives = names[best], [meshes[best]], [found[best]]

    def _objective(self, mesh: trimesh.Trimesh, name: str, *, smooth: bool) -> float:
        """Return the objective of a surface; infinite if it cannot be traced."""
        try:
            return self.comparison.objective(mesh, self.level, smooth=smooth)
        except SonoNerfError as error:
            self._note(f"{name} cannot be compared and counts as the worst: {error}")
            return math.inf

    def _note(self, fault: str) -> None:
        """Record a fault, and warn of it once."""
        if fault not in self.faults:
            self.faults.append(fault)
            logger.warning("%s", fault)

    def _descend(self, mesh: trimesh.Trimesh) -> Descent:
        stage = self.stages[self.stage]
        last = self.stage == len(self.stages) - 1
        self.level.learns = "none" if self.echoes.calibrated and not last else "each"
        correction = None
        if stage.beyond == "simulate":
            self._later, correction = None, self._correction(mesh)
        elif stage.beyond == "none":
            self._later = None
        elif stage.beyond == "trace" or self._later is None:
            source = self.candidates[self._source]
            self._later = LaterBounces(self.optics, source, self.echoes, seed=self.seed)
            self._later.trace(self._coming())
        return Descent(
            mesh,
            self.echoes,
            self.optics,
            self.level,
            smoothing=stage.smoothing * self.optics.wavelength,
            rate=stage.rate,
            later=self._later,
            correction=correction,
            # The simulator's correction is more exact than the onsets.
            onsets=None if correction is not None else self.onsets,
            sheet=self.way == "sheet",
            band=stage.band,
            seed=self.seed,
        )

    def _coming(self) -> list[int]:
        """Return the poses of all further steps that use the later bounces of this surface."""
        steps = self.stages[self.stage].steps - self.step
        for stage in itertools.takewhile(
            lambda stage: stage.beyond == "keep", self.stages[self.stage + 1 :]
        ):
            steps += stage.steps
        drawn = [
            self.echoes.batch(self.seed, self.drawn + step, POSES).tolist() for step in range(steps)
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
        start = -1 if self.start is None else list(self.starts).index(self.start)
        way = self.ways.index(self.way)
        found = {
            "progress": torch.tensor([self.stage, self.step, self.drawn, start, way, self._source]),
            "objectives": torch.tensor(self.objectives, dtype=torch.float64),
            "history": torch.tensor(
                [
                    (one["stage"], self.ways.index(one["way"]), *list(one.values())[2:])
                    for one in self.history
                ],
                dtype=torch.float64,
            ).reshape(-1, 4),
            "faults": torch.tensor(list("\n".join(self.faults).encode()), dtype=torch.uint8),
            **{f"level.{name}": part for name, part in self.level.state().items()},
        }
        meshes = {f"candidate.{number}": mesh for number, mesh in enumerate(self.candidates)}
        meshes.update({f"rival.{number}": mesh for number, mesh in enumerate(self._rivals)})
        for name, mesh in meshes.items():
            found[f"{name}.vertices"] = torch.as_tensor(np.array(mesh.vertices))
            found[f"{name}.faces"] = torch.as_tensor(np.array(mesh.faces))
        if self._descent is not None:
            parts = self._descent.state()
            found.update({f"descent.{name}": part for name, part in parts.items()})
        return found

    def load(self, state: dict[str, Tensor]) -> None:
        """Go on from a state; meshes, echoes, optics, seed and stages must be the same."""
        self.stage, self.step, self.drawn, start, way, self._source = (
            int(part) for part in state["progress"]
        )
        self.start = None if start < 0 else list(self.starts)[start]
        self.way = self.ways[way]
        self.objectives = state["objectives"].tolist()
        self.history = [
            {
                "stage": int(stage),
                "way": self.ways[int(way)],
                "mismatch_db": mismatch,
                "objective_db": objective,
            }
            for stage, way, mismatch, objective in state["history"].tolist()
        ]
        self.faults = bytes(state["faults"].tolist()).decode().splitlines()
        self.level.load({name: state[f"level.{name}"] for name in self.level.state()})
        self.candidates, self._rivals = _meshes(state, "candidate"), _meshes(state, "rival")
        self._later, self._descent = None, None
        parts = {k.removeprefix("descent."): v for k, v in state.items() if k[:8] == "descent."}
        if parts:
            begun = trimesh.Trimesh(parts["start"].numpy(), parts["faces"].numpy(), process=False)
            self._descent = self._descend(begun)
            self._descent.load(parts)

    def result(self) -> Refined:
        """Return the best surface so far; the start where none explains more."""
        if self.start is None:
            self._choose()
        good = TOLERATED * min(self.objectives)
        better = [n for n, found in enumerate(self.objectives) if found < self.objectives[0]]
        best = max([n for n in better if self.objectives[n] <= good], default=0)
        mesh = self.candidates[best]
        confidence = poses_that_hear(mesh, self.echoes, self.optics).cpu().double().numpy()
        if best:
            mesh, confidence = finer(mesh, confidence, self.optics.wavelength)
        gain = self.level.gain.exp().cpu().double().numpy()
        assert self.start is not None
        error = self.objectives[best]
        kept = best > 0
        return Refined(mesh, gain, confidence, self.start, kept, error, self.history, self.faults)


def _meshes(state: dict[str, Tensor], name: str) -> list[trimesh.Trimesh]:
    """Return the meshes ``name.0``, ``name.1`` and so on of a state."""
    found: list[trimesh.Trimesh] = []
    while f"{name}.{len(found)}.vertices" in state:
        parts = (state[f"{name}.{len(found)}.{part}"].numpy() for part in ("vertices", "faces"))
        found.append(trimesh.Trimesh(*parts, process=False))
    return found


def _plain(mesh: trimesh.Trimesh) -> trimesh.Trimesh:
    return trimesh.Trimesh(
        np.array(mesh.vertices, dtype=np.float64),
        np.array(mesh.faces, dtype=np.int64),
        process=False,
    )
