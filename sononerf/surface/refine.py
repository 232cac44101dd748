# SPDX-License-Identifier: MIT
"""Refine a surface against measured spectrograms: stages from coarse to fine, the best is kept."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
import trimesh
from numpy.typing import NDArray
from torch import Tensor

from sononerf.echoes.free_space import EchoHull
from sononerf.errors import SonoNerfError
from sononerf.simulation.simulator import Simulator
from sononerf.surface.comparison import Comparison
from sononerf.surface.correction import Correction
from sononerf.surface.descent import Descent, poses_that_hear
from sononerf.surface.echo_data import Echoes
from sononerf.surface.objective import Level
from sononerf.surface.onset_ranges import OnsetRanges
from sononerf.surface.optics import Optics
from sononerf.surface.remesh import finer, remesh
from sononerf.surface.stages import SHARP, STAGES, Stage
from sononerf.surface.traced import LaterBounces

SIMULATED = 96
"""Training poses for which a surface is simulated; each is drawn about three times."""
Simulate = Callable[[trimesh.Trimesh], Simulator]
TOLERATED = 1.15
"""Objectives of validation poses that differ by less than this factor differ by chance. A later
stage is preferred up to it."""


@dataclass(frozen=True, eq=False)
class Refined:
    """A refined surface.

    Attributes
    ----------
    mesh : Trimesh
        m.
    gain : (E, F) float64
        What rendered magnitudes are multiplied by, learned on training poses.
    support : (V,) float64
        How many training poses see each vertex near the direction of a mirror.
    start : int
        Which of the starts was refined.
    kept : bool
        True where the refined surface explains the validation poses better than the start.
    error_db : float
        Objective on validation poses, see :class:`~sononerf.surface.comparison.Comparison`.
    history : list of dict
        Per stage: its number, whether it is sharp, the mismatch of its last step, and the objective
        on validation poses after it.
    """

    mesh: trimesh.Trimesh
    gain: NDArray[np.float64]
    support: NDArray[np.float64]
    start: int
    kept: bool
    error_db: float
    history: list[dict[str, Any]]


class Refinement:
    """Refine step by step; between any two steps it can be stopped, saved and taken up again.

    Parameters
    ----------
    meshes : sequence of Trimesh
        Where to start, m; of several the one that explains the validation poses best.
    echoes : Echoes
        What was measured.
    optics : Optics
        The head; its device is that of the computation.
    hull : EchoHull or None
        Onsets of the training poses; the surface must begin there.
    simulate : callable
        Makes the simulator of a surface, for the stages that are corrected by it.
    seed : int
        Of the order of poses and of traced rays.
    stages : tuple of Stage
        From coarse to fine.
    calibrated : bool
        Whether the measured level is absolute, as the simulator's is. Then gains are learned in
        the last stage alone: a rough surface is too faint, and a gain would excuse it.
    """

    def __init__(
        self,
        meshes: Sequence[trimesh.Trimesh],
        echoes: Echoes,
        optics: Optics,
        *,
        hull: EchoHull | None = None,
        simulate: Simulate,
        seed: int,
        stages: tuple[Stage, ...] = STAGES,
        calibrated: bool = True,
    ) -> None:
        self.simulate = simulate
        self.calibrated = calibrated
        self.echoes, self.optics, self.seed, self.stages = echoes, optics, seed, stages
        like = optics.get_buffer("wavenumber")
        self.level = Level(optics.ears, len(optics.frequencies), like)
        self.onsets = None if hull is None else OnsetRanges(hull, optics.resolution, seed)
        self.candidates = [_plain(mesh) for mesh in meshes]
        self.objectives: list[float] = []
        self.start: int | None = None
        self.stage, self.step, self.drawn = 0, 0, 0
        self.sharp = False
        self.history: list[dict[str, Any]] = []
        self._rival: trimesh.Trimesh | None = None
        self._descent: Descent | None = None
        self._later: LaterBounces | None = None
        self._source = 0  # the candidate whose later bounces are added
        self.comparison = Comparison(echoes, optics, self.onsets, seed, calibrated=calibrated)

    @property
    def total(self) -> int:
        """Number of steps of all stages."""
        return self.stages[0].steps + sum(stage.steps for stage in self.stages)

    @property
    def done(self) -> bool:
        """Whether nothing is left to do."""
        return self.stage >= len(self.stages)

    def advance(self) -> float:
        """Do one step; return its mismatch, dB."""
        stage = self.stages[self.stage]
        if self.start is None:
            self._choose()
        if self._descent is None:
            unit = self.optics.wavelength
            edge, blur = (SHARP, 0.0) if self.sharp else (stage.edge, stage.blur)
            made = remesh(self.candidates[-1], min(edge, stage.edge) * unit, blur * unit)
            if stage.beyond == "trace":
                self._source = len(self.candidates) - 1
            self._descent = self._descend(self.candidates[-1] if made is None else made)
        mismatch = self._descent.step(self.drawn, self.step / stage.steps)
        self.step += 1
        self.drawn += 1
        if self.step == stage.steps:
            self._finish(mismatch)
        return mismatch

    def _finish(self, mismatch: float) -> None:
        """End a stage; the first one is done twice."""
        assert self._descent is not None
        mesh, self._descent, self.step = self._descent.mesh(), None, 0
        objective = self.comparison.objective(mesh, self.level, smooth=True)
        self.history.append(
            {
                "stage": self.stage,
                "sharp": self.sharp,
                "mismatch_db": mismatch,
                "objective_db": objective,
            }
        )
        if self.stage == 0 and self._rival is None:
            self._rival, self.sharp = mesh, True
            self.level.reset()
            return
        if self.stage == 0:
            blurred = self.history[-2]["objective_db"]
            if blurred <= objective:
                mesh, objective, self.sharp = self._rival, blurred, False
        self.candidates.append(mesh)
        self.objectives.append(objective)
        self.stage += 1

    def _choose(self) -> None:
        """Keep the start that explains the validation poses best."""
        objectives = [
            self.comparison.objective(mesh, self.level, smooth=False) for mesh in self.candidates
        ]
        self.start = int(np.argmin(objectives))
        self.candidates, self.objectives = [self.candidates[self.start]], [min(objectives)]

    def _descend(self, mesh: trimesh.Trimesh) -> Descent:
        stage = self.stages[self.stage]
        last = self.stage == len(self.stages) - 1
        self.level.learns = "each" if last else "none" if self.calibrated else "whole"
        correction = None
        if stage.beyond == "simulate":
            self._later, correction = None, self._correction(mesh)
        elif stage.beyond == "none":
            self._later = None
        elif stage.beyond == "trace" or self._later is None:
            source = self.candidates[self._source]
            self._later = LaterBounces(self.optics, source, self.echoes, seed=self.seed)
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
            seed=self.seed,
        )

    def _correction(self, mesh: trimesh.Trimesh) -> Correction | None:
        """Return the correction on a surface; None where it cannot be simulated."""
        training = self.echoes.training
        rng = np.random.default_rng([self.seed, self.stage])
        numbers = rng.choice(training, min(SIMULATED, len(training)), replace=False)
        fine, _ = finer(mesh, np.zeros(len(mesh.vertices)), self.optics.wavelength)
        try:
            simulator = self.simulate(fine)
            return Correction(self.optics, mesh, simulator, self.echoes, numbers, seed=self.seed)
        except SonoNerfError:
            return None

    def state(self) -> dict[str, Tensor]:
        """Return all that is needed to go on, as plain tensors."""
        start = -1 if self.start is None else self.start
        found = {
            "progress": torch.tensor(
                [self.stage, self.step, self.drawn, start, int(self.sharp), self._source]
            ),
            "objectives": torch.tensor(self.objectives, dtype=torch.float64),
            "history": torch.tensor(
                [[float(part) for part in one.values()] for one in self.history],
                dtype=torch.float64,
            ).reshape(-1, 4),
            **{f"level.{name}": part for name, part in self.level.state().items()},
        }
        meshes = {f"candidate.{number}": mesh for number, mesh in enumerate(self.candidates)}
        if self._rival is not None:
            meshes["rival"] = self._rival
        for name, mesh in meshes.items():
            found[f"{name}.vertices"] = torch.as_tensor(np.array(mesh.vertices))
            found[f"{name}.faces"] = torch.as_tensor(np.array(mesh.faces))
        if self._descent is not None:
            parts = self._descent.state()
            found.update({f"descent.{name}": part for name, part in parts.items()})
        return found

    def load(self, state: dict[str, Tensor]) -> None:
        """Go on from a state; meshes, echoes, optics, seed and stages must be the same."""
        self.stage, self.step, self.drawn, start, sharp, self._source = (
            int(part) for part in state["progress"]
        )
        self.start, self.sharp = None if start < 0 else start, bool(sharp)
        self.objectives = state["objectives"].tolist()
        names = ("stage", "sharp", "mismatch_db", "objective_db")
        kinds = (int, bool, float, float)
        self.history = [
            {name: kind(part) for name, kind, part in zip(names, kinds, row, strict=True)}
            for row in state["history"].tolist()
        ]
        self.level.load({name: state[f"level.{name}"] for name in self.level.state()})
        count = sum(key.endswith(".vertices") and key.startswith("candidate.") for key in state)
        self.candidates = [_mesh(state, f"candidate.{number}") for number in range(count)]
        self._rival = _mesh(state, "rival") if "rival.vertices" in state else None
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
        support = poses_that_hear(mesh, self.echoes, self.optics).double().cpu().numpy()
        if best:
            mesh, support = finer(mesh, support, self.optics.wavelength)
        gain = self.level.gain.exp().double().cpu().numpy()
        start = self.start or 0
        error = self.objectives[best]
        return Refined(mesh, gain, support, start, best > 0, error, self.history)


def _mesh(state: dict[str, Tensor], name: str) -> trimesh.Trimesh:
    vertices, faces = (state[f"{name}.{part}"].numpy() for part in ("vertices", "faces"))
    return trimesh.Trimesh(vertices, faces, process=False)


def _plain(mesh: trimesh.Trimesh) -> trimesh.Trimesh:
    return trimesh.Trimesh(
        np.array(mesh.vertices, dtype=np.float64),
        np.array(mesh.faces, dtype=np.int64),
        process=False,
    )
