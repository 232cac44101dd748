# SPDX-License-Identifier: MIT
"""Heads without a pattern of their own in air without loss, so that levels are absolute."""

import numpy as np
import trimesh

from sononerf.head.ears import Ears
from sononerf.head.front_end import echo_samples
from sononerf.head.head import Head
from sononerf.scene.scene import Scene
from sononerf.settings.schema import SpectrogramSettings
from sononerf.simulation.hearing import Hearing
from sononerf.simulation.impulse_response import plan_synthesis
from sononerf.simulation.rays import Rays
from tests.simulation.exact import SPEED

ANALYSIS = SpectrogramSettings(range_max=0.8)
SYNTHESIS = plan_synthesis(ANALYSIS, echo_samples(ANALYSIS, SPEED))
NODES = SYNTHESIS.nodes
RIGHT = {"rays": 40_000, "bounces": 1}


def hearing(emitter=(0.0, 0.0, 0.0), ears=((0.0, 0.0, 0.0),), absorption=0.0):
    """Points that send and hear alike in all directions."""
    return Hearing(OpenHead(emitter, ears, absorption), SYNTHESIS)


class OpenHead(Head):
    """A head whose gains are 1 everywhere."""

    def __init__(self, emitter, ears, absorption):
        super().__init__(spectrogram=ANALYSIS)
        self.__dict__.update(
            emitter=np.array(emitter, dtype=float),
            receivers=np.array(ears, dtype=float),
            speed_of_sound=SPEED,
            loss=absorption,
        )

    def __getstate__(self):
        return self.__dict__

    def tables(self, frequency):
        grid = (len(frequency), 3, 5)
        return Ears(
            np.linspace(-np.pi, np.pi, 5),
            np.linspace(-np.pi / 2, np.pi / 2, 3),
            np.asarray(frequency),
            np.ones(grid, np.float32),
            np.ones((len(self.receivers), *grid), np.float32),
            self.emitter,
            self.receivers,
        )

    def absorption(self, frequency):
        return np.full(len(frequency), self.loss)


class TableHead(OpenHead):
    """A head with tables at the nodes of a synthesis."""

    def __init__(self, tables):
        super().__init__(tables.emitter, tables.positions, 0.0)
        self.__dict__["given"] = tables

    def tables(self, frequency):
        return self.given


def rays(mesh, material, head=None, **options):
    scene = mesh if isinstance(mesh, Scene) else Scene(mesh, material)
    return Rays(scene, head or hearing(), **{**RIGHT, **options})


def echoes(engine, position=(0.0, 0.0, 0.0), rotation=None, seed=0):
    rotation = np.eye(3) if rotation is None else rotation
    return engine.echo(np.array(position, dtype=float), rotation, seed=seed)


def spectrum(echo, frequency, since=0.0, until=np.inf):
    """Of what comes from ranges of ``since`` to ``until``, m."""
    time = np.arange(echo.shape[-1]) * 1e-6
    way = time * SPEED / 2
    echo = np.where((way >= since) & (way < until), echo, 0.0)
    return echo @ np.exp(-2j * np.pi * time[:, None] * frequency)


def level_db(pressure):
    return 20.0 * np.log10(np.abs(pressure))


def delay(pressure, frequency):
    """Range (m) from the slope of the phase over frequency."""
    slope = np.polyfit(frequency, np.unwrap(np.angle(pressure)), 1)[0]
    return -slope * SPEED / (4.0 * np.pi)


def ball(radius, middle=(0.0, 0.0, 0.0), subdivisions=5):
    mesh = trimesh.creation.icosphere(subdivisions=subdivisions, radius=radius)
    mesh.apply_translation(middle)
    return mesh


def wall(distance, lower, upper):
    """Two triangles square to x."""
    (y0, z0), (y1, z1) = lower, upper
    corners = [[distance, y, z] for y, z in ((y0, z0), (y1, z0), (y1, z1), (y0, z1))]
    return trimesh.Trimesh(corners, [[0, 1, 2], [0, 2, 3]], process=False)


def disc(radius, distance, pieces=360):
    angle = np.linspace(0.0, 2.0 * np.pi, pieces, endpoint=False)
    rim = np.stack([0.0 * angle, radius * np.cos(angle), radius * np.sin(angle)], axis=1)
    index = np.arange(pieces)
    faces = np.stack([np.full(pieces, pieces), index, np.roll(index, -1)], axis=1)
    corners = np.array([distance, 0.0, 0.0]) + np.vstack([rim, np.zeros(3)])
    return trimesh.Trimesh(corners, faces, process=False)


def box(lower, upper):
    lower, upper = np.array(lower, float), np.array(upper, float)
    mesh = trimesh.creation.box(upper - lower)
    mesh.apply_translation((lower + upper) / 2)
    return mesh
