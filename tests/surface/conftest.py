# SPDX-License-Identifier: MIT
"""A sphere, a head that hears it, and a few poses."""

from __future__ import annotations

import numpy as np
import pytest
import torch
import trimesh

from sononerf.geometry.poses import Poses
from sononerf.run.build import head_of
from sononerf.scene.scene import Scene
from sononerf.settings.loading import validate_settings
from sononerf.simulation.simulator import Simulator
from sononerf.surface.refine.optics import Optics
from tests.memory import deaf_hull, echoes_of

RADIUS = 0.012
POSES = 18


def given(**changes):
    wanted = {
        "scene": {"name": "sphere"},
        "simulation": {"engine": "rays", "rays": 20_000, "bounces": 1},
        "spectrogram": {"range_min": 0.2, "range_max": 0.4},
        **changes,
    }
    return validate_settings(wanted, "test")


@pytest.fixture(scope="session")
def settings():
    return given()


@pytest.fixture(scope="session")
def ball():
    return trimesh.creation.icosphere(subdivisions=3, radius=RADIUS)


@pytest.fixture(scope="session")
def bumpy():
    """A bumpy sphere: a round one tells no lateral shift."""
    mesh = trimesh.creation.icosphere(subdivisions=4, radius=RADIUS)
    way = np.asarray(mesh.vertices) / RADIUS
    bump = 1.0 + 0.12 * np.sin(5 * way[:, 0]) * np.cos(4 * way[:, 1] + 1)
    return trimesh.Trimesh(RADIUS * bump[:, None] * way, mesh.faces, process=False)


@pytest.fixture(scope="session")
def optics(settings):
    return Optics(head_of(settings))


@pytest.fixture(scope="session")
def poses():
    return Poses.sphere(POSES, radius=0.3, aim_jitter=0.1, generator=np.random.default_rng(0))


@pytest.fixture(scope="session")
def simulated():
    """Spectrograms (P, E, R, F) of a mesh, by the simulator."""

    def simulate(mesh, settings, poses):
        simulator = Simulator(Scene(mesh), head_of(settings), settings.simulation)
        pairs = zip(poses.positions, poses.rotations, strict=True)
        return np.stack([simulator.spectrogram(at, turn, seed=0) for at, turn in pairs])

    return simulate


@pytest.fixture(scope="session")
def echoes(settings, ball, poses, simulated):
    fine = trimesh.creation.icosphere(subdivisions=5, radius=RADIUS)
    heard = simulated(fine, settings, poses)
    at = poses.positions, poses.rotations
    return echoes_of(head_of(settings), *at, lambda i: heard[i], hull=deaf_hull())


@pytest.fixture(autouse=True)
def one_thread():
    before = torch.get_num_threads()
    torch.set_num_threads(1)
    yield
    torch.set_num_threads(before)
