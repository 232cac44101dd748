# SPDX-License-Identifier: MIT
"""Echoes that the simulator traces off the current surface."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
import trimesh
from numpy.typing import NDArray
from torch import Tensor

from sononerf.array_types import Floats, Ints, Singles
from sononerf.echoes.echoes import Echoes
from sononerf.settings.schema import SimulationSettings
from sononerf.simulation.ensemble import spectrograms
from sononerf.simulation.rays import Rays
from sononerf.simulation.simulator import Simulator, quiet_scene
from sononerf.surface.refine.optics import Heard, Optics

BOUNCES = 3
"""As the simulator's default; what comes later is faint."""
LATER_RAYS = 4_000
"""Per pose, of the later bounces; only their power is used."""
FAINT = 3e-3
"""Echoes below this part of the strongest are left out: 50 dB."""


@dataclass(frozen=True, eq=False)
class Later:
    """Echoes of one pose after the first bounce.

    Attributes:
        ear (N,): Which ear hears it.
        delay ((N,), s): From the emission.
        weight ((N, F) float32): Strength at the nodes that the optics keep, with spread and
            absorption.
    """

    ear: Ints
    delay: Floats
    weight: Singles


class Tracer:
    """The simulator's rays on a surface.

    Args:
        optics: Head, air, call and analysis.
        mesh: The surface, m.
        rays: Per pose.
        seed: Of the pattern of rays.
    """

    def __init__(self, optics: Optics, mesh: trimesh.Trimesh, *, rays: int, seed: int) -> None:
        wanted = SimulationSettings(
            engine="rays",
            rays=rays,
            bounces=BOUNCES,
            diffraction_points=max(rays // 30, 1),  # as many as the simulator's defaults have
        )
        self._simulator = Simulator.of(quiet_scene(mesh), optics.head, wanted)
        self._optics, self._seed = optics, seed

    def spectrograms(self, positions: Floats, rotations: Floats) -> Singles:
        """Magnitude that poses hear, (P, E, R, F)."""
        return spectrograms(self._simulator, positions, rotations, seed=self._seed)

    def later(self, position: Floats, rotation: Floats) -> Later:
        """Return what a pose hears after the first bounce."""
        found = _Collected(self._optics)
        engine = self._simulator.engine
        assert isinstance(engine, Rays)
        engine.later(found, position, rotation, seed=self._seed)
        return found.whole()


class LaterBounces:
    """Later bounces off one surface, traced for a pose when first asked for.

    Args:
        optics: What hears.
        mesh: The surface, m.
        echoes: Of whose poses.
        seed: Of the rays.
    """

    def __init__(self, optics: Optics, mesh: trimesh.Trimesh, echoes: Echoes, *, seed: int) -> None:
        self._optics, self._echoes = optics, echoes
        self._tracer = Tracer(optics, mesh, rays=LATER_RAYS, seed=seed)
        self._kept: dict[int, Later] = {}

    def power(self, numbers: list[int], heard: Heard) -> Tensor:
        """Power (P, E, W, F) of poses, on the rows that were rendered."""
        positions, rotations = self._echoes.positions, self._echoes.rotations
        for number in numbers:
            if number not in self._kept:
                self._kept[number] = self._tracer.later(positions[number], rotations[number])
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


class _Collected:
    """Keeps echoes with what spread and air leave of them."""

    def __init__(self, optics: Optics) -> None:
        self._optics = optics
        self._parts: list[tuple[NDArray[Any], ...]] = []

    def add(
        self, ear: int, delay: NDArray[Any], spread: NDArray[Any], strength: NDArray[Any]
    ) -> None:
        """Take echoes: delay (N,) s, spread (N,) s, strength (N, F)."""
        optics = self._optics
        speed = optics.speed_of_sound
        k, decay = (optics.get_buffer(name).cpu().numpy() for name in ("wavenumber", "decay"))
        loss = np.multiply.outer(0.5 * (spread * speed) ** 2, k**2)
        loss += np.multiply.outer(delay * speed, decay)
        weight = strength[:, optics.kept_nodes] * np.exp(-loss)
        self._parts.append((np.full(len(delay), ear), delay, weight.astype(np.float32)))

    def whole(self) -> Later:
        """Return them all but the faintest."""
        if not self._parts:
            nodes = len(self._optics.kept_nodes)
            return Later(np.zeros(0, np.int64), np.zeros(0), np.zeros((0, nodes), np.float32))
        ear, delay, weight = (np.concatenate(parts) for parts in zip(*self._parts, strict=True))
        loud = weight.max(axis=1)
        kept = loud > FAINT * loud.max(initial=0.0)
        return Later(ear[kept], delay[kept], weight[kept])
