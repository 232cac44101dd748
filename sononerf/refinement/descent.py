# SPDX-License-Identifier: MIT
"""Stages of a refinement: vertices move along their normals until the echoes agree.

In: a mesh, echoes, a stage with its edge length, blur and steps. Out: the mesh after the stage. A
step is the gradient of the mismatch in decibels over its usual size at the vertex, smoothed along
the surface (a Sobolev gradient). Section 5 of ``docs/method.md``.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable
from dataclasses import dataclass
from typing import Literal

import numpy as np
import torch
import trimesh
from scipy.spatial import cKDTree
from torch import Tensor

from sononerf.echoes.echoes import Echoes
from sononerf.geometry.raycast import Occlusion
from sononerf.refinement.objective import (
    ONSET_WEIGHT,
    ErrorLevel,
    OnsetRanges,
    differences,
    measured,
    mismatch,
)
from sononerf.refinement.optics import Heard, Optics
from sononerf.refinement.remesh import MeshOperators, smoothing_passes, unit
from sononerf.refinement.tracer import Correction, LaterBounces, StillSurface, listen, sight_of
from sononerf.start.network import StartMethod

POSES = 8
"""Number of training poses per step."""
LAST_STEP = 0.2
"""Final step length over the initial one, no unit; cosine decay in between."""
MOMENTUM = 0.8
"""Decay rate per step of the running mean of the gradient, no unit."""
SQUARE_DECAY = 0.95
"""Decay rate per step of the running mean of the squared gradient, no unit."""
LOCAL_FLOOR = 0.1
"""Floor of the local mean square of the gradient, as a fraction of its mean over the surface: steps
stay small where little is heard."""
TANGENTIAL_FRACTION = 0.2
"""Fraction of the tangential way to the neighbours' mean that a vertex moves per step; it keeps
triangles even."""
VISIBILITY_STEPS = 4
"""Number of steps for which the search structure of visibility is kept."""
STANDING_HEIGHT = 0.1
"""Height over the support up to which a vertex stays on it, edges. Surfaces are cut at the support
to within a small part of an edge."""
MIN_THICKNESS = 0.15
"""Least thickness of a wall, shortest wavelengths. A thinner one sounds the same, but its sides
could change places, and each would hide the other: a leaf lost a third of itself so."""
MIN_SUPPORT = 0.5
"""Fade and spread at the lowest frequency above which a pose supports a vertex."""


class Descent:
    """Preconditioned descent on one connectivity. In: smoothing (m)."""

    def __init__(
        self,
        mesh: trimesh.Trimesh,
        echoes: Echoes,
        optics: Optics,
        level: ErrorLevel,
        *,
        smoothing: float,
        rate: float,
        later: LaterBounces | None = None,
        correction: Correction | None = None,
        onsets: OnsetRanges | None = None,
        band: float = 0.0,
        seed: int,
    ) -> None:
        self.echoes, self.optics, self.level, self.seed = echoes, optics, level, seed
        like = optics.get_buffer("wavenumber")
        self.faces = np.array(mesh.faces, dtype=np.int64)
        self.operators = MeshOperators(
            torch.as_tensor(self.faces).to(like.device), len(mesh.vertices)
        )
        self.vertices = torch.as_tensor(np.array(mesh.vertices, dtype=np.float64)).to(like.device)
        edge = self.operators.edge_length(self.vertices)
        self.smoothing = smoothing
        self.strength = smoothing**2 / (1.5 * edge**2)
        self.passes = smoothing_passes(optics.wavelength, edge)
        self.direction = torch.zeros(len(self.vertices), 1, dtype=torch.float64).to(like.device)
        self.square = torch.zeros_like(self.direction)
        self.count = 0
        self._start = self._seen = self.vertices
        self._sight: Occlusion | None = None
        self._later, self._correction, self._onsets = later, correction, onsets
        self.rate, self.band = rate, band
        self._walls = Walls(mesh, MIN_THICKNESS * optics.wavelength)
        if optics.plane is not None:  # no vertex goes below it, and vertices on it stay there
            self._stands = optics.plane.height(self.vertices) < STANDING_HEIGHT * edge

    def mesh(self) -> trimesh.Trimesh:
        """Return the present surface."""
        return trimesh.Trimesh(self.vertices.cpu().numpy().copy(), self.faces, process=False)

    def step(self, number: int, part: float) -> float:
        """Do one step. Out: mismatch (dB)."""
        normals = unit(self.operators.areas(self.vertices))
        gradient, error = self._gradient(number, normals)
        if gradient is None:
            return error
        self.count += 1
        smooth = self.operators.smoothed(gradient, self.strength)
        self.direction = MOMENTUM * self.direction + (1 - MOMENTUM) * smooth
        self.square = SQUARE_DECAY * self.square + (1 - SQUARE_DECAY) * smooth.square()
        usual = self.operators.smoothed(self.square, 2.0 * self.strength).clamp_min(0.0)
        usual = usual / (1 - SQUARE_DECAY**self.count)
        usual = torch.sqrt(usual + LOCAL_FLOOR * usual.mean()).clamp_min(1e-300)
        rate = self.rate * self.smoothing
        rate *= LAST_STEP + (1 - LAST_STEP) * 0.5 * (1 + math.cos(math.pi * part))
        move = self.direction / (1 - MOMENTUM**self.count) / usual
        move = self.operators.smoothed(move, self.strength)
        self.vertices = self.vertices - rate * move.clamp(-4.0, 4.0) * normals
        self.vertices = self.operators.relaxed(self.vertices, normals, TANGENTIAL_FRACTION)
        self.vertices = self._walls.apart(self.vertices, normals)
        if (plane := self.optics.plane) is not None:
            height = plane.height(self.vertices)
            off = torch.where(self._stands, height, height.clamp_max(0.0))[:, None]
            self.vertices = self.vertices - off * torch.tensor(plane.normal).to(self.vertices)
        return error

    def render(self, numbers: list[int]) -> tuple[Heard | None, Tensor, Tensor]:
        """Render poses of the present surface. Out: points, areas ((V, 3) float32)."""
        area = self.operators.areas(self.vertices)
        bending = self.operators.bending(self.vertices, unit(area), self.passes)
        moved = self._seen is not self.vertices
        if self._sight is None or (moved and self.count % VISIBILITY_STEPS == 0):
            self._seen = self.vertices
            self._sight = sight_of(self.optics, self._seen.cpu().numpy(), self.faces)
        places = torch.as_tensor(self.echoes.positions[numbers]).to(self.vertices)
        turns = torch.as_tensor(self.echoes.rotations[numbers]).to(self.vertices)
        pieces, heads, middle = listen(
            self.optics, self.operators, self.vertices, area, bending, self._sight, places, turns
        )
        points = (self.vertices - middle).float().requires_grad_(True)
        areas = area.float().requires_grad_(True)
        if not len(pieces.pose):
            return None, points, areas
        return self.optics.render(points, areas, pieces, heads), points, areas

    def _gradient(self, number: int, normals: Tensor) -> tuple[Tensor | None, float]:
        """Return the gradient along the normals (V, 1), and the mean mismatch in dB."""
        source = self._correction or self.echoes
        numbers = source.batch(self.seed, number, POSES).tolist()
        heard, points, areas = self.render(numbers)
        if heard is None:
            return None, math.inf
        later = None if self._later is None else self._later.power(numbers, heard)
        echo = measured(self.echoes, numbers, heard)
        corrected = None
        if self._correction is not None:
            corrected = self._correction.magnitudes(numbers, heard)
        difference, weight = differences(
            heard, later, echo, self.level, corrected=corrected, learn=True, band=self.band
        )
        errors = mismatch(difference, weight)
        errors.mean().backward()
        moved = self.vertices.clone().requires_grad_(True)
        to_points, to_areas = points.grad, areas.grad
        assert to_points is not None
        assert to_areas is not None
        (through,) = torch.autograd.grad(self.operators.areas(moved), moved, to_areas.double())
        total = through + to_points.double()
        if self._onsets is not None:
            total = total + ONSET_WEIGHT * self._onsets.gradient(self.vertices, number)
        return (total * normals).sum(1, keepdim=True), float(errors.detach().mean())


_OPPOSED = -0.5  # cosine between the normals of the two sides of a wall, at most
_AROUND = 16  # number of vertices among which the opposite one is searched for


class Walls:
    """Pairs of opposite vertices of thin walls, which stay apart. In: least thickness (m)."""

    def __init__(self, mesh: trimesh.Trimesh, least: float) -> None:
        places, normals = np.asarray(mesh.vertices), np.asarray(mesh.vertex_normals)
        _, near = cKDTree(places).query(places, k=min(_AROUND, len(places)))
        opposed = np.einsum("vkd,vd->vk", normals[near], normals) < _OPPOSED
        some = np.flatnonzero(opposed.any(axis=1))
        self._vertex = torch.as_tensor(some)
        self._other = torch.as_tensor(near[some, opposed[some].argmax(axis=1)])
        self._least = least

    def apart(self, vertices: Tensor, normals: Tensor) -> Tensor:
        """Return the vertices (V, 3), moved outward where a wall is too thin.

        In: vertices ((V, 3), m), normals (V, 3).
        """
        one, other = (part.to(vertices.device) for part in (self._vertex, self._other))
        gap = ((vertices[one] - vertices[other]) * normals[one]).sum(1, keepdim=True)
        short = (self._least - gap).clamp_min(0.0)
        return vertices.index_add(0, one, 0.5 * short * normals[one])


def poses_that_hear(mesh: trimesh.Trimesh, echoes: Echoes, optics: Optics) -> Tensor:
    """Number of training poses that see each vertex near the direction of a mirror, (V,)."""
    surface, training = StillSurface(mesh, optics), echoes.training
    count = torch.zeros(len(surface.vertices), device=surface.vertices.device)
    for some in np.array_split(training, -(-len(training) // POSES)):
        pieces, heads, _ = surface.listen(echoes.positions[some], echoes.rotations[some])
        near = pieces.reach.amax(1) > MIN_SUPPORT
        pose = pieces.pose[near] % heads.poses
        # On a support a pose may see a vertex by several paths.
        vertex = torch.unique(pieces.vertex[near] * heads.poses + pose) // heads.poses
        count.index_add_(0, vertex, torch.ones_like(vertex, dtype=count.dtype))
    return count


@dataclass(frozen=True)
class Stage:
    """One stage; lengths in the shortest wavelength of the analysed band."""

    smoothing: float  # Length over which steps are smoothed
    edge: float  # Edge of the triangles
    blur: float  # Blur of the signed distance before the stage
    rate: float  # Length of the first steps, smoothing lengths
    steps: int  # Steps of descent
    # Addition to the first bounce by physical optics: nothing; the power of later bounces, traced
    # off the initial surface of the stage, or those that were traced last; or the correction by the
    # simulator, see :mod:`sononerf.refinement.tracer`
    beyond: Literal["none", "trace", "keep", "simulate"]
    # Fraction of the frequencies over which power is averaged before the comparison, 0 to 1. The
    # interference of a surface that is off by more than a fraction of a wavelength differs from
    # that of the true one; the average shows how much power comes from each range
    band: float = 0.0


STAGES = (
    Stage(smoothing=2.4, edge=0.8, blur=1.2, rate=0.08, steps=40, beyond="none", band=1.0),
    Stage(smoothing=2.4, edge=0.8, blur=0.6, rate=0.08, steps=30, beyond="trace", band=1.0),
    Stage(smoothing=2.0, edge=0.8, blur=0.6, rate=0.06, steps=30, beyond="keep", band=0.33),
    Stage(smoothing=1.5, edge=0.7, blur=0.4, rate=0.04, steps=30, beyond="trace"),
    Stage(smoothing=1.0, edge=0.6, blur=0.2, rate=0.02, steps=30, beyond="keep"),
    Stage(smoothing=0.7, edge=0.5, blur=0.0, rate=0.02, steps=40, beyond="simulate"),
)
SHARP_EDGE = 0.5
"""Edge length of the triangles if the surface is not blurred, shortest wavelengths. The first stage
runs both blurred and sharp, and the surface that explains the validation poses better continues.
Blur removes dents and necks, but also edges, sheets and wires."""
CHANCE_RATIO = 1.15
"""Ratio of the errors of planes and of another candidate up to which both go on after the first
stage. Of 24 bodies four are in doubt; one of them needs planes, another one does not
(``docs/notes/surface.md``)."""
Schedule = Literal["blurred", "sharp", "planes"]
"""How a surface goes through the stages. ``blurred``: with the blur and the edges of each stage,
unless the blur would take away thin parts. ``sharp``: without blur, on fine triangles. ``planes``:
its flat parts move as planes, and are found anew in each stage."""


@dataclass(eq=False)
class Candidate:
    """A start that goes through the stages by one schedule."""

    schedule: Schedule
    start: StartMethod  # Name of the start
    level: ErrorLevel  # Its gains and errors
    meshes: list[trimesh.Trimesh]  # The start, and the surface after each stage so far, m
    # Objectives of these on the validation poses; NaN for the start, which is not compared
    objectives: list[float]
    # Number of its steps so far; it determines their poses, so that a candidate does not depend on
    # the others
    drawn: int = 0

    @property
    def best(self) -> int:
        """Number of the surface with the least objective; that of the start, 0, does not count."""
        return 1 + int(np.argmin(self.objectives[1:]))

    @property
    def objective(self) -> float:
        """Objective of the best surface, dB."""
        return self.objectives[self.best]


def below(state: dict[str, Tensor], name: str) -> dict[str, Tensor]:
    """Return the tensors whose names begin with a name, by the rest of theirs."""
    return {key.removeprefix(name): part for key, part in state.items() if key.startswith(name)}


def planned(
    starts: Iterable[StartMethod], *, flat: bool = False
) -> list[tuple[StartMethod, Schedule]]:
    """Return the start and the schedule of each candidate."""
    pairs: list[tuple[StartMethod, Schedule]] = []
    for name in starts:
        if not flat and name in ("fuller", "isosurface", "given"):
            pairs.append((name, "blurred"))
        pairs.append((name, "sharp"))
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
    """Return the steps of a refinement of start methods, at most: planes may go on too."""
    pairs = planned(starts)
    going_on = 2 if ("levels", "sharp") in pairs else 1
    return len(pairs) * stages[0].steps + going_on * sum(stage.steps for stage in stages[1:])


def after_first_stage(
    candidates: list[Candidate], misfit: Callable[[trimesh.Trimesh], float]
) -> list[Candidate]:
    """Return the candidates that go on: the one with the least objective, planes, or both in doubt.

    Planes are compared with it by the errors of the echoes alone, because free surfaces follow the
    onsets and planes do not.
    """
    pair = [one for one in candidates if one.schedule == "planes"]
    if free := [one for one in candidates if one.schedule != "planes"]:
        pair.append(min(free, key=lambda one: one.objectives[-1]))
    errors = [one.objectives[-1] - misfit(one.meshes[-1]) for one in pair]
    near = CHANCE_RATIO * min(errors)
    return [one for one, error in zip(pair, errors, strict=True) if error <= near]
