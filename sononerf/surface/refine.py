# SPDX-License-Identifier: MIT
"""Refine a surface against measured spectrograms: stages from coarse to fine, the best is kept."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any, Literal

import numpy as np
import torch
import trimesh
from numpy.typing import NDArray
from torch import Tensor

from sononerf.errors import SonoNerfError
from sononerf.simulation.simulator import Simulator
from sononerf.surface.correction import Correction
from sononerf.surface.descent import Descent, poses_that_hear
from sononerf.surface.echo_data import Echoes
from sononerf.surface.objective import ACTIVE_DB, FLOOR_DB, Level
from sononerf.surface.optics import Optics
from sononerf.surface.remesh import finer, remesh
from sononerf.surface.traced import LaterBounces, Tracer

_DB = 20.0 / math.log(10.0)
RAYS = 30_000
"""Per validation pose; off three spheres they give what 300,000 give to 0.2 dB."""
SIMULATED = 96
"""Training poses for which a surface is simulated; each is drawn about three times."""
Simulate = Callable[[trimesh.Trimesh], Simulator]
TOLERATED = 1.15
"""Errors of validation poses that differ by less than this factor differ by chance. A later stage
is preferred up to it, and a refined surface is kept only if the start's error is larger by it. On a
procedural shape with 200 calls 5 % less error came with twice the distance from the truth."""
ASKED = 16
"""At most so many validation poses are asked about each stage's surface."""


@dataclass(frozen=True)
class Stage:
    """One stage; lengths in the shortest wavelength of the analysed band.

    Attributes
    ----------
    smoothing : float
        Length over which steps are smoothed.
    edge : float
        Of the triangles.
    blur : float
        Of the signed distance before the stage.
    steps : int
        Of descent.
    beyond : {"none", "trace", "keep", "simulate"}
        What is added to the first bounce by physical optics: nothing; the power of later bounces,
        traced off the surface that the stage starts from, or those that were traced last; or the
        correction by the simulator, see :mod:`sononerf.surface.correction`.
    """

    smoothing: float
    edge: float
    blur: float
    steps: int
    beyond: Literal["none", "trace", "keep", "simulate"]


STAGES = (
    Stage(smoothing=2.4, edge=0.8, blur=1.2, steps=40, beyond="none"),
    Stage(smoothing=2.0, edge=0.8, blur=0.6, steps=30, beyond="trace"),
    Stage(smoothing=1.5, edge=0.7, blur=0.4, steps=30, beyond="keep"),
    Stage(smoothing=1.0, edge=0.6, blur=0.2, steps=30, beyond="trace"),
    Stage(smoothing=0.7, edge=0.5, blur=0.0, steps=40, beyond="simulate"),
)


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
        Mean error of validation poses, traced off the surface.
    history : list of dict
        Per stage: its number, the mismatch of its last step, errors of all candidates then.
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
        self.candidates = [_plain(mesh) for mesh in meshes]
        self.start: int | None = 0 if len(meshes) == 1 else None
        self.stage, self.step, self.drawn = 0, 0, 0
        self.history: list[dict[str, Any]] = []
        self._descent: Descent | None = None
        self._later: LaterBounces | None = None
        self._traced: dict[int, NDArray[np.float32]] = {}
        chosen = np.linspace(0, len(echoes.validation) - 1, min(ASKED, len(echoes.validation)))
        self._asked = echoes.validation[chosen.astype(np.int64)]

    @property
    def total(self) -> int:
        """Number of steps of all stages."""
        return sum(stage.steps for stage in self.stages)

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
            made = remesh(self.candidates[-1], stage.edge * unit, stage.blur * unit)
            self._descent = self._descend(self.candidates[-1] if made is None else made)
        mismatch = self._descent.step(self.drawn, self.step / stage.steps)
        self.step += 1
        self.drawn += 1
        if self.step == stage.steps:
            self.candidates.append(self._descent.mesh())
            errors = self.errors()
            self.history.append({"stage": self.stage, "mismatch_db": mismatch, "error_db": errors})
            self._descent = None
            self.stage, self.step = self.stage + 1, 0
        return mismatch

    def _choose(self) -> None:
        """Keep the start that explains the validation poses best."""
        self.start = int(np.argmin(self.errors()))
        self.candidates = [self.candidates[self.start]]
        self._traced = {0: self._traced[self.start]}

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
            earlier = [n for n in range(self.stage + 1) if self.stages[n].beyond == "trace"]
            source = self.candidates[earlier[-1] if earlier else self.stage]
            self._later = LaterBounces(self.optics, source, self.echoes, seed=self.seed)
        return Descent(
            mesh,
            self.echoes,
            self.optics,
            self.level,
            smoothing=stage.smoothing * self.optics.wavelength,
            later=self._later,
            correction=correction,
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

    def errors(self) -> list[float]:
        """Mean error of each candidate for validation poses, traced off it, dB; the start first.

        Over cells within :data:`FLOOR_DB` of a pose's loudest, with the gains and weights that
        were learned last, for all alike.
        """
        weight = self.level.weight.cpu().numpy()[:, None]
        gain = self.level.gain.exp().cpu().numpy()[:, None]
        found = []
        for number in range(len(self.candidates)):
            errors = []
            for pose, rendered in zip(self._asked.tolist(), self._trace(number), strict=False):
                heard = self.echoes.magnitude(pose).numpy()
                if not heard.any():
                    continue
                reference = float(heard.max()) * 10.0 ** (-FLOOR_DB / 20.0)
                a, b = (_DB * np.log1p(part / reference) for part in (heard, rendered * gain))
                counts = ((a >= ACTIVE_DB) | (b >= ACTIVE_DB)) * weight
                errors.append(float((np.abs(a - b) * counts).sum() / max(counts.sum(), 1e-12)))
            found.append(float(np.mean(errors)) if errors else math.inf)
        return found

    def _trace(self, number: int) -> NDArray[np.float32]:
        """Return the calls of validation poses (P, E, R, F); none where a mesh cannot be traced."""
        if number not in self._traced:
            positions, rotations = self.echoes.positions, self.echoes.rotations
            found = []
            try:
                mesh = self.candidates[number]
                if number:
                    mesh, _ = finer(mesh, np.zeros(len(mesh.vertices)), self.optics.wavelength)
                tracer = Tracer(self.optics, mesh, rays=RAYS, seed=self.seed)
                found = [tracer.spectrogram(positions[i], rotations[i]) for i in self._asked]
            except SonoNerfError:
                found = []
            self._traced[number] = np.stack(found) if found else np.zeros(0, np.float32)
        return self._traced[number]

    def state(self) -> dict[str, Tensor]:
        """Return all that is needed to go on, as plain tensors."""
        found = {
            "progress": torch.tensor(
                [self.stage, self.step, self.drawn, -1 if self.start is None else self.start]
            ),
            **{f"level.{name}": part for name, part in self.level.state().items()},
        }
        for number, mesh in enumerate(self.candidates):
            found[f"candidate.{number}.vertices"] = torch.as_tensor(np.array(mesh.vertices))
            found[f"candidate.{number}.faces"] = torch.as_tensor(np.array(mesh.faces))
        if self._descent is not None:
            parts = self._descent.state()
            found.update({f"descent.{name}": part for name, part in parts.items()})
        history = [(one["stage"], one["mismatch_db"]) for one in self.history]
        found["history"] = torch.tensor(history, dtype=torch.float64).reshape(-1, 2)
        return found

    def load(self, state: dict[str, Tensor]) -> None:
        """Go on from a state; meshes, echoes, optics, seed and stages must be the same."""
        self.stage, self.step, self.drawn, start = (int(part) for part in state["progress"])
        self.start = None if start < 0 else start
        self.level.load({name: state[f"level.{name}"] for name in self.level.state()})
        count = sum(key.endswith(".vertices") and key.startswith("candidate.") for key in state)
        self.candidates = [
            trimesh.Trimesh(
                state[f"candidate.{number}.vertices"].numpy(),
                state[f"candidate.{number}.faces"].numpy(),
                process=False,
            )
            for number in range(count)
        ]
        self._traced, self._later, self._descent = {}, None, None
        parts = {k.removeprefix("descent."): v for k, v in state.items() if k[:8] == "descent."}
        if parts:
            start = trimesh.Trimesh(parts["start"].numpy(), parts["faces"].numpy(), process=False)
            self._descent = self._descend(start)
            self._descent.load(parts)
        self.history = [
            {"stage": int(stage), "mismatch_db": float(mismatch), "error_db": []}
            for stage, mismatch in state["history"].tolist()
        ]

    def result(self) -> Refined:
        """Return the best surface so far; the start where none explains more."""
        errors = self.errors()
        good = max(TOLERATED * min(errors), 1e-12)
        # The latest that is as good as any: traced errors of fine stages differ by chance.
        best = max(n for n, error in enumerate(errors) if error <= good or n == 0)
        best = best if TOLERATED * errors[best] < errors[0] else 0
        mesh = self.candidates[best]
        support = poses_that_hear(mesh, self.echoes, self.optics).double().cpu().numpy()
        if best:
            mesh, support = finer(mesh, support, self.optics.wavelength)
        gain = self.level.gain.exp().double().cpu().numpy()
        start = self.start or 0
        return Refined(mesh, gain, support, start, best > 0, errors[best], self.history)


def _plain(mesh: trimesh.Trimesh) -> trimesh.Trimesh:
    return trimesh.Trimesh(
        np.array(mesh.vertices, dtype=np.float64),
        np.array(mesh.faces, dtype=np.int64),
        process=False,
    )


def refine(
    meshes: Sequence[trimesh.Trimesh],
    echoes: Echoes,
    optics: Optics,
    *,
    simulate: Simulate,
    seed: int,
    stages: tuple[Stage, ...] = STAGES,
    calibrated: bool = True,
    progress: Callable[[int, int, float], None] | None = None,
    state: dict[str, Tensor] | None = None,
    between: Callable[[Refinement], None] | None = None,
) -> Refined:
    """Refine a surface from start to end; see :class:`Refinement`.

    Parameters
    ----------
    meshes, echoes, optics, simulate, seed, stages, calibrated
        As there.
    progress : callable, optional
        Takes how many steps are done, how many there are, and the mismatch in dB.
    state : dict of Tensor, optional
        To go on from, see :meth:`Refinement.state`.
    between : callable, optional
        Called after each step; it may save the state, or raise to stop.
    """
    work = Refinement(
        meshes,
        echoes,
        optics,
        simulate=simulate,
        seed=seed,
        stages=stages,
        calibrated=calibrated,
    )
    if state is not None:
        work.load(state)
    while not work.done:
        mismatch = work.advance()
        if progress is not None:
            progress(work.drawn, work.total, mismatch)
        if between is not None:
            between(work)
    return work.result()
