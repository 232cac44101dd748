# SPDX-License-Identifier: MIT
"""Visibility of a surface from emitter and ears, and what the simulator traces off it."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np
import torch
import trimesh
from numpy.typing import NDArray
from torch import Tensor

from sononerf.echoes.echoes import Echoes
from sononerf.geometry.raycast import Occlusion
from sononerf.numerics import Bools, Floats, Ints, Singles
from sononerf.refinement.optics import SILENT_EXPONENT, Heads, Heard, Optics, Pieces
from sononerf.refinement.remesh import MeshOperators, smoothing_passes, unit
from sononerf.resources import computed
from sononerf.scene.scene import Scene
from sononerf.settings.schema import SimulationSettings
from sononerf.simulation.ensemble import spectrograms
from sononerf.simulation.simulator import Simulator, useful_workers

if TYPE_CHECKING:
    from sononerf.refinement.optics import Optics

FREE_DISTANCE = 0.25
"""Distance in front of a piece within which nothing hides it, shortest wavelengths. Objects so
close throw no shadow, and the other side of a thin sheet that was pushed through must not hide
it."""


def seen(sight: Occlusion, points: Floats, target: Floats, *, free: float) -> Bools:
    """Return the mask of points (N, 3), m, on the surface that targets (N, 3) see.

    In: points, target ((N, 3), m), free (m).
    """
    span = target - points
    distance = np.sqrt(np.einsum("nd,nd->n", span, span))[:, None]
    part = np.minimum(free / np.maximum(distance, 1e-300), 0.5)
    return ~sight.blocked(points + part * span, target)


def sight_of(optics: Optics, vertices: Floats, faces: Ints) -> Occlusion:
    """Return the search structure of a surface, on a support with its image.

    In: vertices ((V, 3), m), faces (T, 3).
    """
    if optics.plane is None:
        return Occlusion(vertices, faces)
    both = np.concatenate([vertices, optics.plane.mirrored(vertices)])
    return Occlusion(both, np.concatenate([faces, faces[:, ::-1] + len(vertices)]))


def listen(
    optics: Optics,
    operators: MeshOperators,
    vertices: Tensor,
    area: Tensor,
    bending: Tensor,
    sight: Occlusion,
    positions: Tensor,
    rotations: Tensor,
) -> tuple[Pieces, Heads, Tensor]:
    """Return the pieces of a surface that poses hear.

    In: vertices, area, bending ((V, 3), (V, 3), (V, 6) float64), positions, rotations ((P, 3), (P,
    3, 3) float64). Out: middle ((3,), m).
    """
    middle = 0.5 * (vertices.amin(0) + vertices.amax(0))
    far = optics.heads(positions, rotations)
    heads = far.about(middle)
    points, areas, bent = (vertices - middle).float(), area.float(), bending.float()
    pose, vertex = _candidates(optics, points, areas, bent, heads)
    visible = _visible(optics, operators, vertices, sight, pose, vertex, far.emitters, far.ears)
    kept = visible.amax(1) > 0.0
    pose, vertex, visible = pose[kept], vertex[kept], visible[kept]
    return optics.pieces(points, areas, bent, pose, vertex, visible, heads), heads, middle


def _candidates(
    optics: Optics, points: Tensor, area: Tensor, bending: Tensor, heads: Heads
) -> tuple[Tensor, Tensor]:
    """Return pairs of pose and vertex (Q,), (Q,) that could hear each other without obstacles."""
    emitters, middles = heads.emitters, heads.ears.mean(1)
    towards = 0.5 * (emitters + middles)
    facing = towards @ area.T > (points * area).sum(1)
    pose, vertex = torch.nonzero(facing, as_tuple=True)
    exponent = optics.near_mirror(
        points[vertex], area[vertex], bending[vertex], emitters[pose], middles[pose]
    )[4]
    heard = exponent < SILENT_EXPONENT
    return pose[heard], vertex[heard]


def _visible(
    optics: Optics,
    operators: MeshOperators,
    vertices: Tensor,
    sight: Occlusion,
    pose: Tensor,
    vertex: Tensor,
    emitters: Tensor,
    ears: Tensor,
) -> Tensor:
    """Visibility of candidates from emitter and ears, (Q, E) float32, softened by neighbours."""
    free = FREE_DISTANCE * optics.wavelength
    points = vertices[vertex].detach().cpu().numpy()
    of = pose.cpu().numpy()
    sources, places = emitters.detach().cpu().numpy(), ears.detach().cpu().numpy()
    lit = np.flatnonzero(seen(sight, points, sources[of], free=free))
    clear = np.zeros((len(points), optics.ears), dtype=np.float32)
    for ear in range(optics.ears):
        clear[lit, ear] = seen(sight, points[lit], places[of[lit], ear], free=free)
    visible = torch.as_tensor(clear).to(vertices.device)
    shape = (operators.count, len(emitters), 1 + optics.ears)
    spread = torch.zeros(shape, dtype=torch.float32, device=vertices.device)
    spread[vertex, pose, 0] = 1.0
    spread[vertex, pose, 1:] = visible
    near = operators.averaged(spread.flatten(1)).unflatten(1, shape[1:])[vertex, pose]
    return near[:, 1:] / near[:, :1].clamp_min(1e-6)


class StillSurface:
    """A surface, prepared once for all poses.

    Attributes:
        operators: Operators on the surface.
        vertices, normals, area ((V, 3) float64): Places (m), outward unit normals and vector areas
            (m²).
        bending ((V, 6), 1/m): Curvature, see :meth:`MeshOperators.bending`.
    """

    def __init__(self, mesh: trimesh.Trimesh, optics: Optics) -> None:
        self.optics = optics
        like = optics.get_buffer("wavenumber")
        faces = np.array(mesh.faces, dtype=np.int64)
        self.vertices = torch.as_tensor(np.array(mesh.vertices, dtype=np.float64)).to(like.device)
        self.operators = MeshOperators(torch.as_tensor(faces).to(like.device), len(self.vertices))
        self.area = self.operators.areas(self.vertices)
        self.normals = unit(self.area)
        passes = smoothing_passes(optics.wavelength, self.operators.edge_length(self.vertices))
        self.bending = self.operators.bending(self.vertices, self.normals, passes)
        sight = sight_of(optics, self.vertices.cpu().numpy(), faces)
        self._parts = self.operators, self.vertices, self.area, self.bending, sight

    def listen(self, positions: Floats, rotations: Floats) -> tuple[Pieces, Heads, Tensor]:
        """Return the pieces that poses hear, see :func:`~.visibility.listen`.

        In: positions, rotations ((P, 3), (P, 3, 3)).
        """
        places, turns = (torch.as_tensor(part).to(self.vertices) for part in (positions, rotations))
        return listen(self.optics, *self._parts, places, turns)

    @torch.no_grad()
    def render(
        self,
        positions: Floats,
        rotations: Floats,
        stretch: Floats | float = 1.0,
        late: Floats | float = 0.0,
    ) -> Singles:
        """Return magnitudes on the whole axis, (P, E, R, F).

        In: positions, rotations ((P, 3), (P, 3, 3)).
        """
        optics = self.optics
        shape = (len(positions), optics.ears, optics.rows, len(optics.frequencies))
        magnitudes = np.zeros(shape, dtype=np.float32)
        pieces, heads, middle = self.listen(positions, rotations)
        if not len(pieces.pose):
            return magnitudes
        points, area = (self.vertices - middle).float(), self.area.float()
        factor, more = (points.new_tensor(part).expand(len(magnitudes)) for part in (stretch, late))
        heard = optics.render(points, area, pieces, heads, stretch=factor, late=more)
        magnitude = heard.power.sqrt().cpu().numpy()
        for one, rendered, row in zip(magnitudes, magnitude, heard.row.tolist(), strict=True):
            first, last = max(row, 0), min(row + rendered.shape[1], optics.rows)
            if last > first:
                one[:, first:last] = rendered[:, first - row : last - row]
        return magnitudes


BOUNCES = 3
"""Number of bounces, the simulator's default; later ones are faint."""
LATER_RAYS = 4_000
"""Number of rays per pose for later bounces; only their power is used."""
MIN_LATER_ECHO = 3e-3
"""Magnitude over the strongest below which echoes are left out: -50 dB."""


@dataclass(frozen=True, eq=False)
class Later:
    """Echoes of one pose after the first bounce."""

    ear: Ints  # (N,): Index of the ear
    delay: Floats  # (N,), s: Time since the emission
    # (N, F) float32: Strength at the nodes that the optics keep, with spread and absorption
    weight: Singles


class Tracer:
    """The simulator's rays on a surface."""

    def __init__(self, optics: Optics, mesh: trimesh.Trimesh, *, rays: int, seed: int) -> None:
        options = SimulationSettings(engine="rays", rays=rays, bounces=BOUNCES)
        self._simulator = Simulator(Scene(mesh, warns=False), optics.head, options)
        self._nodes, self._seed = _Nodes.of(optics), seed

    def spectrograms(self, positions: Floats, rotations: Floats) -> Singles:
        """Magnitude that poses hear, (P, E, R, F)."""
        return spectrograms(self._simulator, positions, rotations, seed=self._seed)

    def later(self, position: Floats, rotation: Floats) -> Later:
        """Return the echoes of a pose after the first bounce."""
        collected = _Collected(self._nodes)
        self._simulator.rays.later(collected, position, rotation, seed=self._seed)
        return collected.whole()


@dataclass(frozen=True, eq=False)
class _Nodes:
    """The nodes that an optics keeps (N,), wave numbers (N,) and decay (N,) there, and c."""

    kept: Ints
    wavenumber: Floats
    decay: Floats
    speed: float

    @classmethod
    def of(cls, optics: Optics) -> _Nodes:
        k, decay = (optics.get_buffer(name).cpu().numpy() for name in ("wavenumber", "decay"))
        return cls(optics.kept_nodes, k, decay, optics.speed_of_sound)


class _Collected:
    """Listener that keeps echoes, attenuated by spread and air."""

    def __init__(self, nodes: _Nodes) -> None:
        self._nodes = nodes
        self._parts: list[tuple[NDArray[Any], ...]] = []

    def add(
        self, ear: int, delay: NDArray[Any], spread: NDArray[Any], strength: NDArray[Any]
    ) -> None:
        """Take echoes: delay (N,) s, spread (N,) s, strength (N, F)."""
        nodes = self._nodes
        loss = np.multiply.outer(0.5 * (spread * nodes.speed) ** 2, nodes.wavenumber**2)
        loss += np.multiply.outer(delay * nodes.speed, nodes.decay)
        weight = strength[:, nodes.kept] * np.exp(-loss)
        self._parts.append((np.full(len(delay), ear), delay, weight.astype(np.float32)))

    def whole(self) -> Later:
        """Return them all but the faintest."""
        if not self._parts:
            nodes = len(self._nodes.kept)
            return Later(np.zeros(0, np.int64), np.zeros(0), np.zeros((0, nodes), np.float32))
        ear, delay, weight = (np.concatenate(parts) for parts in zip(*self._parts, strict=True))
        loud = weight.max(axis=1)
        kept = loud > MIN_LATER_ECHO * loud.max(initial=0.0)
        return Later(ear[kept], delay[kept], weight[kept])


class LaterBounces:
    """Later bounces off one surface."""

    def __init__(self, optics: Optics, mesh: trimesh.Trimesh, echoes: Echoes, *, seed: int) -> None:
        self._optics, self._echoes = optics, echoes
        self._tracer = Tracer(optics, mesh, rays=LATER_RAYS, seed=seed)
        self._kept: dict[int, Later] = {}

    def trace(self, numbers: Iterable[int]) -> None:
        """Trace those of some poses that were not traced before; many at a time go faster."""
        positions, rotations = self._echoes.positions, self._echoes.rotations
        left = {n: (positions[n], rotations[n]) for n in numbers if n not in self._kept}
        workers = useful_workers(len(left), LATER_RAYS)
        if workers > 1:
            self._kept.update(computed(Tracer.later, self._tracer, left, workers))
        else:
            self._kept.update({n: self._tracer.later(*pose) for n, pose in left.items()})

    def power(self, numbers: list[int], heard: Heard) -> Tensor:
        """Power (P, E, W, F) of poses, on the rows that were rendered."""
        self.trace(numbers)
        found = [self._kept[number] for number in numbers]
        pose = np.repeat(np.arange(len(found)), [len(one.ear) for one in found])
        ear, delay, weight = (
            torch.as_tensor(np.concatenate([getattr(one, name) for one in found]))
            for name in ("ear", "delay", "weight")
        )
        like = heard.power
        return self._optics.later_power(
            torch.as_tensor(pose).to(like.device),
            ear.to(like.device),
            delay.to(like.device),
            weight.to(like.device),
            heard,
        )


class Correction:
    """Simulated and rendered echoes of one surface, for some poses. In: numbers (N,)."""

    def __init__(
        self,
        optics: Optics,
        mesh: trimesh.Trimesh,
        simulator: Simulator,
        echoes: Echoes,
        numbers: Ints,
        *,
        seed: int,
    ) -> None:
        self.numbers = numbers
        self._echoes = echoes
        self._surface = StillSurface(mesh, optics)
        self._kept: dict[int, tuple[Tensor, Tensor]] = {}
        places = np.asarray(echoes.positions[numbers], dtype=np.float64)
        turns = np.asarray(echoes.rotations[numbers], dtype=np.float64)
        heard = spectrograms(simulator, places, turns, seed=seed)
        self._simulated = dict(zip(numbers.tolist(), torch.as_tensor(heard), strict=True))

    def batch(self, seed: int, step: int, size: int) -> Ints:
        """Return the poses of a step, drawn from the seed and the step's number."""
        rng = np.random.default_rng([seed, step])
        return rng.choice(self.numbers, min(size, len(self.numbers)), replace=False)

    def magnitudes(self, numbers: list[int], heard: Heard) -> tuple[Tensor, Tensor]:
        """Return simulated and rendered echoes of the surface.

        Out: simulated, rendered ((P, E, W, F) float32).
        """
        for number in numbers:
            if number not in self._kept:
                at = slice(number, number + 1)
                echoes = self._echoes.positions[at], self._echoes.rotations[at]
                rendered = torch.as_tensor(self._surface.render(*echoes)[0])
                self._kept[number] = self._simulated[number], rendered
        first, second = (
            on_rows([self._kept[number][part] for number in numbers], heard.row, heard.power)
            for part in (0, 1)
        )
        return first, second


def on_rows(wholes: list[Tensor], row: Tensor, like: Tensor) -> Tensor:
    """Return range slices of whole spectrograms, from given first rows on.

    In: wholes (list of (E, R, F) float32), row (P,), like ((P, E, W, F) Tensor). Out: parts ((P, E,
    W, F) float32).
    """
    width = like.shape[2]
    parts = []
    for whole, start in zip(wholes, row.tolist(), strict=True):
        first, last = max(start, 0), min(start + width, whole.shape[1])
        part = torch.zeros(whole.shape[0], width, whole.shape[2])
        if last > first:
            part[:, first - start : last - start] = whole[:, first:last]
        parts.append(part)
    return torch.stack(parts).to(like.device)
