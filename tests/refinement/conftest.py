# SPDX-License-Identifier: MIT
"""A sphere, a head that hears it, and a few poses; a turned box, new and worn."""

from __future__ import annotations

import numpy as np
import pytest
import torch
import trimesh

from sononerf.geometry.poses import Poses
from sononerf.refinement.optics import Optics
from sononerf.refinement.remesh import remesh
from sononerf.run.simulate import head_of
from sononerf.scene.scene import Scene
from sononerf.settings.loading import validate_settings
from sononerf.simulation.simulator import Simulator
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


SIDES = (0.06, 0.04, 0.03)
EDGE = 1.5e-3


@pytest.fixture(scope="session")
def turned_box():
    found = trimesh.creation.box(SIDES)
    turn = trimesh.transformations.euler_matrix(0.3, 0.8, 1.9)
    return found.apply_transform(turn)


@pytest.fixture(scope="session")
def worn(turned_box):
    """The box with rounded edges, and waves of half a millimetre on its faces."""
    found = remesh(turned_box.subdivide_to_size(2e-3), EDGE, 1.5e-3)
    places = np.asarray(found.vertices)
    wave = 4e-4 * np.sin(places @ np.array([250.0, 120.0, 90.0]))
    moved = places + wave[:, None] * np.asarray(found.vertex_normals)
    return trimesh.Trimesh(moved, found.faces, process=False)
