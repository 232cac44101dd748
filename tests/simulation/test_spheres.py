# SPDX-License-Identifier: MIT
import numpy as np
import pytest
import trimesh

from sononerf.config import validate_settings
from sononerf.scene import Scene
from sononerf.simulation.simulator import Simulator
from sononerf.simulation.solved import Heads
from tests.simulation.exact import SPEED, rigid_sphere
from tests.simulation.listening import ball, level_db

POINT_HEAD = {
    "emitter": [0, 0, 0], "left": [0, 0, 0], "beam_radius": 0, "azimuth_deg": 0,
    "elevation_deg": 0, "width_deg": 180, "notch_depth": 0,
}  # fmt: skip
SOURCE = np.array([0.3, 0.1, -0.05])


class Everywhere(Heads):
    """Heads that send and hear alike in all directions."""

    def __getitem__(self, some):
        return Everywhere(self.emitters[some], self.ears[some], self.rotations[some], self.gains)

    def beam(self, points):
        return np.ones((len(self), len(points)))

    def gain(self, ear, points):
        return np.ones((len(self), len(points)))


def spheres(*bodies, frequency_max=100e3):
    """Engine for spheres given as (radius, centre)."""
    mesh = trimesh.util.concatenate([ball(*body, subdivisions=3) for body in bodies])
    wanted = {"engine": "spheres", "frequency_max": frequency_max}
    sections = {"scene": {"name": "t"}, "simulation": wanted, "ears": POINT_HEAD}
    analysis = {"frequency_max": 80e3}
    settings = validate_settings({**sections, "spectrogram": analysis}, "test")
    return Simulator.from_settings(Scene(mesh), settings).engine


def heard(engine, frequency, emitter, ear):
    """Pressure at one ear of heads without a pattern, in air without loss."""
    poses = Everywhere(np.array([emitter]), np.array([[ear]]), np.eye(3)[None], None)
    return engine.respond(complex(2 * np.pi * frequency / SPEED), poses)[0, 0]


@pytest.mark.parametrize("frequency", [500.0, 5e3, 40e3, 120e3])
def test_one_sphere_answers_like_the_exact_series(frequency):
    centre, ear = np.array([0.01, 0.02, -0.03]), np.array([0.2, 0.2, 0.1])
    engine = spheres((0.015, centre))
    found = heard(engine, frequency, SOURCE, ear)
    to, back = SOURCE - centre, ear - centre
    lengths = np.linalg.norm(to), np.linalg.norm(back)
    angle = np.arccos(to @ back / np.prod(lengths))
    expected = rigid_sphere(frequency, engine.balls[0].radius, *lengths, angle)[0]
    assert abs(level_db(found / expected)) < 0.02
    assert abs(np.angle(found / expected)) < 1e-3
