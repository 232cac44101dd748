# SPDX-License-Identifier: MIT
"""Echoes of solvers that were exact and slow, frozen in ``judges.npz``.

Commit 933aa75 made them, by ``python tools/judges.py tests/simulation/judges.npz``. Its engines
``spheres`` (multiple scattering), ``bem`` (boundary elements) and ``kirchhoff`` (physical optics)
were removed afterwards; what they were checked against is in ``docs/simulator.md``. Each case holds
the pressure at the ears for a call that is one sample of height 1, at 1 MHz, cut to where it is not
zero.
"""

from dataclasses import dataclass
from pathlib import Path

import numpy as np
import trimesh

from sononerf.scene.material import RIGID
from sononerf.scene.scene import Scene, load_scene
from tests.simulation.listening import ball

FILE = Path(__file__).with_name("judges.npz")
SMALL = {"frequency_max": 40e3, "range_max": 0.6}
"""Analysis of ``balls``, ``leaf`` and ``beaker``, whose echoes are whole up to 41.7 kHz."""
SOLVED = 48e3, 48e3 / 1.15
"""Where their responses have fallen to zero, as a raised cosine, and from where on, Hz."""


@dataclass(frozen=True, eq=False)
class Case:
    """Echoes of a case: poses (P, 3) and (P, 3, 3), pressure (P, E, S) from sample start (P, E)."""

    position: np.ndarray
    rotation: np.ndarray
    echo: np.ndarray
    start: np.ndarray

    @classmethod
    def load(cls, name):
        with np.load(FILE) as file:
            parts = {
                key: file[f"{name}/{key}"] for key in ("position", "rotation", "echo", "start")
            }
        return cls(**parts)

    def record(self, pose, samples):
        """Return the pressure at the ears of a pose from the emission on, (E, S)."""
        record = np.zeros((self.echo.shape[1], samples))
        for ear, start in enumerate(self.start[pose]):
            part = self.echo[pose, ear][: max(samples - start, 0)]
            record[ear, start : start + len(part)] = part
        return record

    def spectrograms(self, head):
        """Return what a head analyses, (P, E, R, F), linear magnitude."""
        records = (self.record(pose, head.samples) for pose in range(len(self.position)))
        return np.stack([head.receive(record, seed=0)[1] for record in records])


def beaker(height=0.04, radius=0.012, wall=1.5e-3):
    """Return the mesh of a beaker that is open at its top (m), its middle in the origin."""
    inner = radius - wall
    profile = [[0, 0], [radius, 0], [radius, height], [inner, height], [inner, wall], [0, wall]]
    mesh = trimesh.creation.revolve(np.array(profile), sections=64)
    mesh.apply_translation([0.0, 0.0, -height / 2.0])
    return mesh


def scene_of(name):
    """Return the scene of ``three_spheres``, ``balls``, ``leaf`` or ``beaker``."""
    if name == "three_spheres":
        return load_scene(name)
    if name == "leaf":
        size = {"length": 0.04, "width": 0.024, "thickness": 3e-4}
        return load_scene("leaf", {**size, "material": "rigid"})
    if name == "beaker":
        return Scene(beaker(), RIGID)
    places = ((0.01, (0, 0, 0)), (0.008, (0.022, 0.004, 0)), (0.006, (0.006, 0.02, 0.01)))
    return Scene(trimesh.util.concatenate([ball(*place) for place in places]), RIGID)


def banded(echo, rate=1e6):
    """Return an echo (..., S) that falls as the solved ones: what lies above would leak below."""
    zero, whole = SOLVED
    frequency = np.fft.rfftfreq(2 * echo.shape[-1], 1.0 / rate)
    fall = np.clip((frequency - whole) / (zero - whole), 0.0, 1.0)
    spectrum = np.fft.rfft(echo, 2 * echo.shape[-1]) * 0.5 * (1.0 + np.cos(np.pi * fall))
    return np.fft.irfft(spectrum)[..., : echo.shape[-1]]


def heard(simulator, case, *, band=None):
    """Return what a simulator makes of the poses of a case, (P, E, R, F), linear magnitude."""
    simulator.low and simulator.low.prepare(case.position, case.rotation)
    found = []
    for seed, pose in enumerate(zip(case.position, case.rotation, strict=True)):
        echo = simulator.echo(*pose, seed=seed)
        found.append(simulator.head.receive(band(echo) if band else echo, seed=seed)[1])
    return np.stack(found)
