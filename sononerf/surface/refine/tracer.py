# SPDX-License-Identifier: MIT
"""What the simulator adds to physical optics: later bounces, traced or kept, and a correction."""

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
from sononerf.executor import computed
from sononerf.numerics import Floats, Ints, Singles
from sononerf.scene.scene import Scene
from sononerf.settings.schema import SimulationSettings
from sononerf.simulation.ensemble import spectrograms
from sononerf.simulation.simulator import Simulator
from sononerf.simulation.workers import useful_workers
from sononerf.surface.refine.optics import Heard, Optics
from sononerf.surface.refine.visibility import StillSurface

if TYPE_CHECKING:
    from sononerf.surface.refine.optics import Optics

BOUNCES = 3
"""Number of bounces, the simulator's default; later ones are faint."""
LATER_RAYS = 4_000
"""Number of rays per pose for later bounces; only their power is used."""
FAINT = 3e-3
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
        options = SimulationSettings(
            engine="rays",
            rays=rays,
            bounces=BOUNCES,
            diffraction_points=max(rays // 30, 1),  # as many as the simulator's defaults have
        )
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
        kept = loud > FAINT * loud.max(initial=0.0)
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
    """Simulated and rendered echoes of one surface, for some poses.

    In: numbers (N,).
    """

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
