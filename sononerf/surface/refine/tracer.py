# SPDX-License-Identifier: MIT
"""The simulator's rays on the current surface; without torch, which workers need not import."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np
import trimesh
from numpy.typing import NDArray

from sononerf.array_types import Floats, Ints, Singles
from sononerf.scene.scene import Scene
from sononerf.settings.schema import SimulationSettings
from sononerf.simulation.ensemble import spectrograms
from sononerf.simulation.simulator import Simulator

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
    """Echoes of one pose after the first bounce.

    Attributes:
        ear (N,): Index of the ear.
        delay ((N,), s): Time since the emission.
        weight ((N, F) float32): Strength at the nodes that the optics keep, with spread and
            absorption.
    """

    ear: Ints
    delay: Floats
    weight: Singles


class Tracer:
    """The simulator's rays on a surface."""

    def __init__(self, optics: Optics, mesh: trimesh.Trimesh, *, rays: int, seed: int) -> None:
        wanted = SimulationSettings(
            engine="rays",
            rays=rays,
            bounces=BOUNCES,
            diffraction_points=max(rays // 30, 1),  # as many as the simulator's defaults have
        )
        self._simulator = Simulator(Scene(mesh, warns=False), optics.head, wanted)
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
